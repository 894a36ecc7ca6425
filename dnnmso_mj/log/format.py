"""What stands where in a log file: the names and formats that its writer and its readers share."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from dnnmso_mj.errors import LogError
from dnnmso_mj.log import step_message
from dnnmso_mj.log.json_texts import read_json
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo
from dnnmso_mj.wording import show

Array = np.ndarray

NS_PER_S = 1_000_000_000
LONGEST = 1e9  # s; what is of a later time was no run's
MODEL = "model.xml"  # the attachment that holds the MJCF
_SNAPSHOT, _NPZ = "snapshot/", ".npz"
_LEVELS = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_LEVEL_NAMES = {number: name for name, number in _LEVELS.items()}


@dataclass(frozen=True)
class Topic:
    """A channel of the log and the schema of its messages."""

    name: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str


def protobuf_topic(name: str, file: FileDescriptor, schema_name: str) -> Topic:
    """A topic of a compiled protobuf schema, together with all the schema imports."""
    files: dict[str, FileDescriptor] = {}

    def collect(part: FileDescriptor) -> None:
        for dependency in part.dependencies:
            collect(dependency)
        files.setdefault(part.name, part)

    collect(file)
    schema = FileDescriptorSet()
    for part in files.values():
        part.CopyToProto(schema.file.add())
    return Topic(name, schema_name, "protobuf", schema.SerializeToString(), "protobuf")


STEP = Topic(
    name="/step",
    schema_name=step_message.SCHEMA_NAME,
    schema_encoding="protobuf",
    schema=step_message.schema().SerializeToString(),
    encoding="protobuf",
)
EVENTS = protobuf_topic("/events", Log.DESCRIPTOR.file, "foxglove.Log")


def unwritable(path: Path, error: OSError) -> LogError:
    """The error to raise when the operating system does not let a file be written."""
    return LogError(
        f"{path} cannot be written: {error.strerror or error}. Choose another place for it."
    )


def timestamp(time_ns: int) -> Timestamp:
    """Simulation time (ns) as protobuf has it."""
    return Timestamp(seconds=time_ns // NS_PER_S, nanos=time_ns % NS_PER_S)


def event_message(event: Event) -> bytes:
    """An event as foxglove.Log."""
    message = Log(
        timestamp=timestamp(round(event.t * NS_PER_S)),
        level=_LEVELS[event.level],
        message=event.message,
        name="dnnmso",
    )
    return message.SerializeToString()


def event_of(data: bytes) -> Event:
    """The event in a foxglove.Log.

    Raises:
        ValueError: the bytes are no foxglove.Log.
    """
    try:
        message = Log.FromString(data)
    except DecodeError as error:
        raise ValueError(f"a message is no {EVENTS.schema_name}") from error
    t = (message.timestamp.seconds * NS_PER_S + message.timestamp.nanos) / NS_PER_S
    if not 0.0 <= t <= LONGEST:
        raise ValueError(f"an event of {t:g} s; expected 0 to {LONGEST:g}")
    return Event(t, _LEVEL_NAMES.get(message.level, "info"), message.message)


def scenario_record(scenario: Scenario) -> dict[str, str]:
    """The metadata record "scenario", which opens a log."""
    return {
        "name": scenario.name,
        "seed": str(scenario.seed),
        "json": scenario.model_dump_json(),
    }


def run_record(info: RunInfo) -> dict[str, str]:
    """The metadata record "run", which ends a log."""
    return {
        "status": info.status,
        "reason": info.reason,
        "seed": str(info.seed),
        "wall_s": repr(float(info.wall_s)),
    }


def metrics_record(metrics: Mapping[str, float | int | bool | None]) -> dict[str, str]:
    """The metadata record "metrics": a JSON value under each name.

    Raises:
        LogError: a metric is not finite.
    """
    for name, value in metrics.items():
        if value is not None and not np.isfinite(value):
            raise LogError(
                f"metric {name} = {value}; allowed: a finite number, true, false or null. "
                "Record a metric that this run does not define as null."
            )
    return {name: json.dumps(value) for name, value in metrics.items()}


def run_info(records: Mapping[str, Mapping[str, str]]) -> RunInfo:
    """What the metadata records of a log say about its run.

    Raises:
        ValueError: a value is not of its type.
    """
    run = {"status": "unfinished", **records.get("scenario", {}), **records.get("run", {})}
    wall_s, seed = float(run.get("wall_s", "0")), int(run.get("seed", "0"))
    if not math.isfinite(wall_s) or abs(seed) >= 1 << 64:
        raise ValueError(f"seed = {show(run['seed'])}, wall_s = {wall_s}")
    metrics = {name: _metric(name, text) for name, text in records.get("metrics", {}).items()}
    return RunInfo(
        status=run["status"],
        seed=seed,
        wall_s=wall_s,
        reason=run.get("reason", ""),
        versions=dict(records.get("versions", {})),
        git_commit=records.get("git", {}).get("commit", ""),
        metrics=metrics,
    )


def _metric(name: str, text: str) -> float | int | bool | None:
    value = read_json(text)
    whole = isinstance(value, int) and abs(value) < 1 << 64  # bool too
    if not (value is None or whole or (isinstance(value, float) and math.isfinite(value))):
        raise ValueError(f"metric {show(name)} = {show(value)}")
    return value  # type: ignore[no-any-return]


def snapshot_name(name: str, t: float) -> str:
    """The name of a snapshot's attachment; it has all digits of t, so that t reads back exactly."""
    return f"{_SNAPSHOT}{name}/{float(t)!r}{_NPZ}"


def snapshot_place(attachment: str) -> tuple[str, float] | None:
    """Name and time (s) of a snapshot from its attachment's name; None when it is no snapshot."""
    name, _, t = attachment.removeprefix(_SNAPSHOT).removesuffix(_NPZ).rpartition("/")
    try:
        place = name, float(t)
    except ValueError:
        return None
    if not 0.0 <= place[1] <= LONGEST:
        return None
    return place if attachment == snapshot_name(*place) else None


def check_snapshot(name: str, arrays: Mapping[str, Array]) -> None:
    """Refuse what cannot be written without pickle.

    Raises:
        LogError: an array holds Python objects.
    """
    for key, array in arrays.items():
        if array.dtype.hasobject:
            raise LogError(
                f"snapshot {name!r}: array {key!r} has dtype {array.dtype}; "
                "allowed: numbers, booleans and strings. Convert it to one of these."
            )


def snapshot_data(arrays: Mapping[str, Array]) -> bytes:
    """Arrays as NumPy's npz, without pickle."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for key, array in arrays.items():
            with archive.open(f"{key}.npy", "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    return data.getvalue()

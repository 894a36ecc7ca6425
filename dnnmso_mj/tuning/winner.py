"""The file of a tuned controller: what it holds, and that it is there whole or not at all."""

from __future__ import annotations

from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.representer import RoundTripRepresenter

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.files import whole_file
from dnnmso_mj.loading.tuned import read_tuned
from dnnmso_mj.scenario import Controller
from dnnmso_mj.scenario.tuned import Tuning
from dnnmso_mj.tuning import TuneError

HEAD = "# Written by `dnnmso tune`; a scenario takes it with  controller: {from: NAME}\n"
NULL, LIST = "tag:yaml.org,2002:null", "tag:yaml.org,2002:seq"


class _Plain(RoundTripRepresenter):
    """Lists on one line, and null written out."""


_Plain.add_representer(type(None), lambda here, _: here.represent_scalar(NULL, "null"))
_Plain.add_representer(list, lambda here, v: here.represent_sequence(LIST, v, flow_style=True))


def check_out(out: Path, *, replace: bool) -> None:
    """Refuse a file that may not be written over, before anything is run for it.

    Args:
        out: the file to be.
        replace: whether a tuned controller may be replaced.

    Raises:
        TuneError: it is there, or is something else.
    """
    if out.is_dir():
        raise TuneError(f"{out}: a folder; allowed: a file, as in pid.yaml")
    if not out.exists():
        return
    try:
        read_tuned(out)
    except ScenarioError as error:
        raise TuneError(
            f"{out}: exists and is not a tuned controller, so nothing is written over it; "
            "allowed: another --out, or remove it first"
        ) from error
    if not replace:
        ways = "allowed: --resume to go on, --force to start anew, or another --out"
        raise TuneError(f"{out}: exists; {ways}")


def write_tuned(out: Path, controller: Controller, tuning: Tuning) -> None:
    """Write a controller, every value spelled out, and how it was found.

    Raises:
        TuneError: the file cannot be written.
    """
    yaml = YAML()
    yaml.Representer = _Plain
    yaml.width = 10_000  # long texts stay on their line
    whole = {"controller": controller.model_dump(mode="json"), "tuning": tuning.model_dump()}
    try:
        with whole_file(out, sync=True) as file:
            file.write(HEAD.encode())
            yaml.dump(whole, file)
            file.flush()
            read_tuned(Path(file.name))
    except OSError as error:
        raise TuneError(f"{out}: cannot be written: {error.strerror or error}") from error

"""Where models, scenarios and logs are, in a checkout as in an installed wheel."""

from __future__ import annotations

from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from dnnmso_mj.errors import DnnmsoError, LogError, ScenarioError
from dnnmso_mj.wording import clean, did_you_mean, show

PACKAGE = Path(__file__).resolve().parent
LITERATURE = "literature"
LOGS = "logs"
LAST = "last"  # the log that was written last
LISTED = 8
MODELS = "dnnmso_mj.models"  # entry points


def models_dir() -> Path:
    """The folder of the shipped MJCF models."""
    return _shipped("models")


def scenarios_dir() -> Path:
    """The folder of the shipped scenarios and their JSON Schema."""
    return _shipped("scenarios")


def controllers_dir() -> Path:
    """The folder of the shipped tuned controllers."""
    return scenarios_dir() / "controllers"


def shipped_controllers() -> list[str]:
    """Names of the shipped tuned controllers."""
    return _names(controllers_dir(), ".yaml")


def logs_dir() -> Path:
    """Where logs go unless told otherwise: `logs` under the current directory."""
    return Path.cwd() / LOGS


def log_names() -> list[str]:
    """Names of the logs in that folder, the newest first."""
    found = Path(LOGS).glob("*.mcap")
    logs = ((path.stat().st_mtime_ns, path.stem) for path in found if _exists(path))
    return [name for _, name in sorted(logs, reverse=True)]


def find_log(source: str | Path) -> Path:
    """Find a log by path, or by a short name.

    Args:
        source: a file; else NAME for logs/NAME.mcap; else "last" for the newest log there.

    Raises:
        LogError: none of them; lists the newest logs.
    """
    path, name = Path(source), str(source).removesuffix(".mcap")
    names = [] if _is_file(path) else log_names()
    if name in names or (name == LAST and names):
        return Path(LOGS) / f"{name if name in names else names[0]}.mcap"
    if _exists(path):
        return path
    shown = clean(str(source)) or "(no name)"
    if not names:
        raise LogError(
            f"{shown}: no such log, and none in {LOGS}; allowed: a log file (.mcap), or, once "
            "`dnnmso run paper` has made one, its name: paper"
        )
    newest = ", ".join([*names[:LISTED], *(["…"] if len(names) > LISTED else [])])
    ways = f"a log file (.mcap), {LAST}, or one of {LOGS}, the newest first: {newest}"
    raise LogError(f"{shown}: no such log; allowed: {ways}{did_you_mean(Path(name).stem, names)}")


def scenario_names() -> list[str]:
    """Names of the shipped scenarios: our own, then other papers' as "literature/…"."""
    folder = scenarios_dir()
    return [
        *_names(folder, ".yaml"),
        *(f"{LITERATURE}/{name}" for name in _names(folder / LITERATURE, ".yaml")),
    ]


def find_scenario(source: str | Path) -> Path:
    """Find a scenario by path, or by the name of a shipped one ("paper", "literature/lewis").

    Raises:
        ScenarioError: no such file, a directory or device, or a name that does not ship.
    """
    path = Path(source)
    if _is_file(path):
        return path
    names = scenario_names()
    name = str(source).removesuffix(".yaml")
    if name in names:
        return scenarios_dir() / f"{name}.yaml"
    problem = "not a regular file" if _exists(path) else "no such file"
    allowed = f"allowed: a YAML file, or one of the shipped scenarios: {', '.join(names)}"
    hint = did_you_mean(path.stem, names)
    raise ScenarioError(f"{clean(str(source)) or '(no name)'}: {problem}; {allowed}{hint}")


def find_model(name: str, base: Path | None = None) -> Path:
    """Find an MJCF by the name of a shipped model, or by path relative to `base`.

    Args:
        name: as in `plant.model`: "two_link", "arms/mine.xml", "/home/me/mine.xml", or what
            `packaged_model` finds.
        base: the scenario's folder; the current directory when left out.

    Returns:
        Absolute path of the file.

    Raises:
        ScenarioError: neither a file nor a shipped or packaged model; lists what there is.
    """
    names = _names(models_dir(), ".xml")
    path = (base or Path.cwd()) / name
    # A plain word is a shipped model, whatever else is called so; anything else is a file first.
    if name not in names and _is_file(path):
        return path.resolve()
    if name.removesuffix(".xml") in names:
        return models_dir() / f"{name.removesuffix('.xml')}.xml"
    packaged = packaged_model(name)
    if packaged is not None:
        return packaged
    names += [point.name for point in entry_points(group=MODELS)]
    ships = f"or one of these models: {', '.join(names)}"
    allowed = f"allowed: an MJCF file, {ships}; or package:file.xml of an installed package"
    hint = did_you_mean(Path(name).stem, names)
    raise ScenarioError(f"no model {show(name)} in {clean(str(path.parent))}; {allowed}{hint}")


def packaged_model(name: str) -> Path | None:
    """Find an MJCF that an installed package brings; None: there is none of that name.

    Args:
        name: "package:file.xml", of a file in the package's folder ("package.folder:file.xml" in
            one below it) and not out of it, or the name of an entry point of the group `MODELS`
            with such a value. Nothing is imported: a robot is data.
    """
    if ":" not in name:
        points = list(entry_points(group=MODELS, name=name))
        return packaged_model(points[0].value) if points and ":" in points[0].value else None
    package, _, file = name.partition(":")
    top, *below = package.strip().split(".")
    if not all(part.isidentifier() for part in (top, *below)):
        return None
    try:
        spec = find_spec(top)
    except ValueError:  # a module that runs or was made by hand, as __main__
        return None
    folders = (spec.submodule_search_locations if spec else None) or ()
    homes = (Path(folder, *below).resolve() for folder in folders)
    paths = ((home, home / file.strip()) for home in homes if "\0" not in file)
    inside = (path.resolve() for home, path in paths if path.resolve().is_relative_to(home))
    return next((path for path in inside if _is_file(path)), None)


def find_controller(name: str, base: Path) -> Path:
    """Find a tuned controller by the name of a shipped one, or by path relative to `base`.

    Raises:
        ScenarioError: neither a file nor a shipped controller; lists what ships.
    """
    names = shipped_controllers()
    path = base / name
    if name not in names and _is_file(path):
        return path
    if name.removesuffix(".yaml") in names:
        return controllers_dir() / f"{name.removesuffix('.yaml')}.yaml"
    allowed = f"allowed: a YAML file, or one of the shipped controllers: {', '.join(names)}"
    hint = did_you_mean(Path(name).stem, names)
    raise ScenarioError(f"no such file in {clean(str(base))}; {allowed}{hint}")


def model_name(path: Path, name: str = "") -> str:
    """What `find_model` finds `path` by from anywhere: the name of a shipped or packaged model.

    Args:
        path: what `find_model` gave.
        name: for what.

    Returns:
        The path, for any other model.
    """
    if path.parent == models_dir():
        return path.stem
    return name if name and packaged_model(name) == path else str(path)


def _shipped(kind: str) -> Path:
    # A wheel carries them inside the package; a checkout has them beside it.
    for folder in (PACKAGE / "data" / kind, PACKAGE.parent / kind):
        if folder.is_dir():
            return folder
    raise DnnmsoError(f"no {kind} folder in or beside {PACKAGE}; install dnnmso_mj again")


def _names(folder: Path, suffix: str) -> list[str]:
    return sorted(path.stem for path in folder.glob(f"*{suffix}"))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name too long
        return False


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False

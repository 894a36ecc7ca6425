"""Short runs of every sort, that succeed, diverge, are refused or broken off, in one process."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dnnmso_mj import load_scenario, read_trace, run_logged, simulate
from dnnmso_mj.environments.episode import Episode
from dnnmso_mj.environments.start import Start, episode_scenario
from dnnmso_mj.errors import DnnmsoError, RunInterrupted
from dnnmso_mj.resume import resume
from dnnmso_mj.scenario import Scenario
from soak.sameness import digest

TICKS = 20
SHORT = f"duration={TICKS / 1000}"
SEEDS = 3
OFTEN = {
    "simulated, pd": 5.0,
    "simulated, dnn_mso": 5.0,
    "episode": 5.0,
    "read": 5.0,
    "logged": 2.0,
}
REFUSED = (
    ("paper", ["dt=banana"]),
    ("paper", ["controller={kind: nobody}"]),
    ("no_such_scenario", []),
    ("paper", ["plant.model=no_such_model"]),
)


class Errands:
    """Does short runs in a random order, and knows what each must give.

    Args:
        folder: for logs, of which none is left.
        seed: of the order.

    Attributes:
        right: how many gave what the first of their sort and seed had given.
        wrong: the others, in words.
        counts: how many of each sort.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        folder.mkdir()
        self._folder = folder
        self._rng = np.random.default_rng(seed)
        self._known: dict[tuple[str, int], str] = {}
        self.right, self.wrong = 0, list[str]()
        self.counts: Counter[str] = Counter()
        self._log = run_logged(_scenario("dnn_mso", 0), folder / "kept.mcap").log
        self._common = load_scenario("paper", [SHORT])
        self._episode = Episode(self._common)
        self._sorts: dict[str, Callable[[int], str]] = {
            "simulated, pd": lambda seed: digest(simulate(_scenario("pd", seed))),
            "simulated, dnn_mso": lambda seed: digest(simulate(_scenario("dnn_mso", seed))),
            "logged": self._logged,
            "episode": self._play,
            "new episode": self._begin,
            "refused": self._refused,
            "read": lambda seed: digest(read_trace(self._log)),
            "read torn": self._torn,
            "resumed": self._resumed,
            "broken off": self._broken_off,
            "diverged": self._diverged,
        }

    @property
    def _shares(self) -> np.ndarray:
        """How often each sort comes: what takes longer more seldom."""
        weights = np.array([OFTEN.get(sort, 1.0) for sort in self._sorts])
        return np.asarray(weights / weights.sum())

    def next(self) -> None:
        """Do one, and compare it with the first of its sort and seed."""
        sort = str(self._rng.choice(list(self._sorts), p=self._shares))
        self._do(sort, int(self._rng.integers(SEEDS)))

    def each(self) -> None:
        """Do one of every sort and seed, so that all code is loaded and every cache begun."""
        for sort in self._sorts:
            for seed in range(SEEDS):
                self._do(sort, seed)

    def _do(self, sort: str, seed: int) -> None:
        self.counts[sort] += 1
        try:
            found = self._sorts[sort](seed)
        except Exception as error:  # whatever it is, the run is lost
            self.wrong.append(f"{sort}, seed {seed}: {type(error).__name__}: {error}")
            return
        if self._known.setdefault((sort, seed), found) == found:
            self.right += 1
        else:
            number = self.counts.total()
            self.wrong.append(f"{sort}, seed {seed}: run {number} is not what the first one was")

    def _logged(self, seed: int) -> str:
        done = run_logged(_scenario("dnn_mso", seed), self._folder / "run.mcap")
        done.log.unlink()
        return digest(done.trace)

    def _play(self, seed: int) -> str:
        episode = self._episode
        episode.restart(episode_scenario(self._common, seed, Start(spread_q=0.1)))
        tau = np.full(episode.scenario.n_joints, 1.0 + seed)
        while not episode.over:
            episode.hold(tau, 1)
        return digest(episode.trace())

    def _begin(self, seed: int) -> str:
        self._episode = Episode(self._common)
        return self._play(seed)

    def _refused(self, seed: int) -> str:
        try:
            scenario = load_scenario(*REFUSED[seed % len(REFUSED)])
            simulate(scenario)
        except DnnmsoError as error:
            return hashlib.sha256(str(error).encode()).hexdigest()
        raise AssertionError("was not refused")

    def _torn(self, seed: int) -> str:
        data = self._log.read_bytes()
        torn = self._folder / "torn.mcap"
        torn.write_bytes(data[: len(data) * (seed + 1) // (SEEDS + 1)])
        try:
            return digest(read_trace(torn))
        except DnnmsoError as error:
            return type(error).__name__
        finally:
            torn.unlink()

    def _resumed(self, seed: int) -> str:
        done = resume(self._log, 0.005 * (seed + 1), [], self._folder / "resumed.mcap")
        done.run.log.unlink()
        return digest(done.run.trace)

    def _broken_off(self, seed: int) -> str:
        def stop(_ticks: int) -> None:
            raise KeyboardInterrupt

        try:
            run_logged(_scenario("pd", seed, 0.2), self._folder / "run.mcap", progress=stop)
        except RunInterrupted as stopped:
            stopped.log.unlink()
            # N.B. how much was run may differ, since the loop's blocks follow its speed.
            return str(stopped.ticks > 0)
        raise AssertionError("was not broken off")

    def _diverged(self, seed: int) -> str:
        trace = simulate(load_scenario("as_printed", ["initial.qd=[999.0, 0.0]", f"seed={seed}"]))
        assert trace.info.status == "diverged", trace.info.status
        return digest(trace)


def _scenario(kind: str, seed: int, duration: float = TICKS / 1000) -> Scenario:
    sets = [f"duration={duration}", f"seed={seed}", f"controller={{kind: {kind}}}"]
    return load_scenario("paper", sets)

"""Tuning: the same budget and the same objective for every controller, on seeds of its own.

`run.tune` searches, `spaces` says what and where, `objective` what for; the winner is a file that a
scenario takes with `controller: {from: NAME}`. This module imports nothing heavy.
"""

from __future__ import annotations

from dnnmso_mj.errors import DnnmsoError


class TuneError(DnnmsoError):
    """A tuning that cannot be accepted, gone on with or written."""

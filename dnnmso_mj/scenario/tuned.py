"""A file that holds a tuned controller, and how it was found."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from dnnmso_mj.scenario.controller import Controller
from dnnmso_mj.scenario.fields import Finite, Strict


class Tuning(Strict):
    """How a controller was found: enough to judge it, and to find it again."""

    study: str
    """Name of the study in its storage."""
    budget: Annotated[int, Field(ge=1)]
    """Trials that were made, the first of them of the untuned controller."""
    seeds: str
    """Seeds that every trial was judged by, as --seeds takes them."""
    scenario: str
    """What was driven."""
    objective: str
    """What was minimised, in words, with its constants."""
    value: Finite
    """What the best trial reached."""
    command: str
    """What makes this file again."""
    date: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$")]
    """When, YYYY-MM-DD."""
    version: str
    """Of dnnmso_mj."""


class TunedController(Strict):
    """What `controller: {from: NAME}` names."""

    controller: Controller
    """Put where `from` stands; further keys beside `from` override it."""
    tuning: Tuning | None = None
    """How it was found; null for one that was set by hand."""

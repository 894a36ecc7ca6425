"""What separates a simulation from a robot: drives, sensors, friction, and what is done to it."""

from __future__ import annotations

from dnnmso_mj.imperfections.actuators import (
    Actuators,
    actuate,
    build_actuators,
    start_actuators,
)
from dnnmso_mj.imperfections.loads import Loads, build_loads, load, start_loads
from dnnmso_mj.imperfections.sensors import SensorBank, Sensors, read, sense
from dnnmso_mj.imperfections.tip import Tip

__all__ = [
    "Actuators",
    "Loads",
    "SensorBank",
    "Sensors",
    "Tip",
    "actuate",
    "build_actuators",
    "build_loads",
    "load",
    "read",
    "sense",
    "start_actuators",
    "start_loads",
]

"""Unit quaternions with the scalar last, as Rerun, Foxglove and ROS have them."""

from __future__ import annotations

import math

import mujoco
import numpy as np

Array = np.ndarray
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
IDENTITY.setflags(write=False)


def xyzw(wxyz: Array) -> Array:
    """MuJoCo's order to this module's. Shape (4,)."""
    return np.roll(np.asarray(wxyz, dtype=float), -1)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product, broadcast over the leading axes. Shape (..., 4)."""
    va, wa, vb, wb = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = wa * vb + wb * va + np.cross(va, vb)
    return np.concatenate([vector, wa * wb - (va * vb).sum(axis=-1, keepdims=True)], axis=-1)


def rotate(quat: Array, vector: Array) -> Array:
    """Turn vectors (..., 3) by unit quaternions (..., 4), broadcast over the leading axes."""
    axis, scalar = quat[..., :3], quat[..., 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + scalar * twice + np.cross(axis, twice)


def from_rotation_vector(rotation: Array) -> Array:
    """Quaternion of a rotation vector (rad). Shape (3,) -> (4,)."""
    angle = float(np.linalg.norm(rotation))
    wxyz = np.zeros(4)
    mujoco.mju_axisAngle2Quat(wxyz, rotation / (angle or 1.0), angle)
    return xyzw(wxyz)


def matrix(quat: Array) -> Array:
    """Rotation matrix. Shape (4,) -> (3, 3)."""
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, np.roll(quat, 1))
    return flat.reshape(3, 3)


def rpy(quat: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw (rad) with R = Rz(yaw) Ry(pitch) Rx(roll).

    Yaw first, roll from what the yaw leaves: exact at a pitch of ±90° too, where a shape along x
    stands and where the usual three formulas lose half the digits.
    """
    r = matrix(quat)
    yaw = math.atan2(r[1, 0], r[0, 0])
    cos, sin = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-r[2, 0], cos * r[0, 0] + sin * r[1, 0])
    roll = math.atan2(sin * r[0, 2] - cos * r[1, 2], cos * r[1, 1] - sin * r[0, 1])
    return roll, pitch, yaw

"""MuJoCo's C functions, callable from compiled code without the interpreter.

Models and data are passed by address (`MjModel._address`), arrays by `.ctypes.data`; whoever passes
an address keeps its object alive. The functions are those of the library that `import mujoco` has
loaded, found by name when compiled code is loaded, so compiled code can be cached.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import mujoco
from numba import types
from numba.core.types import ExternalFunction

_LIBRARY = next(Path(mujoco.__file__).parent.glob("libmujoco.so*"))
llvm.load_library_permanently(str(_LIBRARY))

_pointer = types.intp


def _function(name: str, *arguments: types.Type) -> Any:
    return ExternalFunction(name, types.void(_pointer, _pointer, *arguments))


# Each takes (model, data).
mj_forward = _function("mj_forward")
mj_Euler = _function("mj_Euler")
mj_implicit = _function("mj_implicit")
mj_kinematics = _function("mj_kinematics")
mj_comPos = _function("mj_comPos")
mj_makeM = _function("mj_makeM")
mj_fwdPosition = _function("mj_fwdPosition")
mj_fwdVelocity = _function("mj_fwdVelocity")

# (model, data, N): N-th order Runge-Kutta; only N = 4 is implemented by MuJoCo.
mj_RungeKutta = _function("mj_RungeKutta", types.int32)
# (model, data, dst): dense M (n, n) into dst.
mj_fullM = _function("mj_fullM", _pointer)
# (model, data, x, y, count): x = M⁻¹ y by the factors that mj_forward leaves.
mj_solveM = _function("mj_solveM", _pointer, _pointer, types.int32)
# (model, data, jacp, jacr, site): the site's Jacobian (3, n) into jacp; jacr may be 0.
mj_jacSite = _function("mj_jacSite", _pointer, _pointer, types.int32)

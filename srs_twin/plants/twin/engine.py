"""Access to the C functions and data of MuJoCo from compiled kernels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types


def c_function(name: str, *more: types.Type) -> Any:
    """Return a C function of MuJoCo that compiled kernels can call.

    The C function takes the addresses of a model and its data, followed by arguments of
    the types in `more`.
    """
    return types.ExternalFunction(name, types.void(types.intp, types.intp, *more))


mj_factorM = c_function("mj_factorM")
mj_solveM = c_function("mj_solveM", types.intp, types.intp, types.int32)
mj_step1 = c_function("mj_step1")
mj_comVel = c_function("mj_comVel")
mj_forwardSkip = c_function("mj_forwardSkip", types.int32, types.int32)
mj_rne = c_function("mj_rne", types.int32, types.intp)
mj_integratePos = c_function("mj_integratePos", types.intp, types.float64)


class EngineData(NamedTuple):
    """Engine data that the friction solve reads and writes.

    Fields that are not listed here are the arrays of `MjData` with the same names.

    Attributes:
        model: address of the `MjModel`, for kernels compiled by numba.
        data: address of the `MjData`, for kernels compiled by numba.
        objects: `ObjectContacts` of movable objects, for kernels compiled by numba. The
            value is None in worlds without objects.
    """

    model: int
    data: int
    objects: tuple[object, ...] | None
    qpos: np.ndarray
    qvel: np.ndarray
    qfrc_applied: np.ndarray
    qacc: np.ndarray
    qfrc_bias: np.ndarray
    M: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    cdof: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray


class StepInputs(NamedTuple):
    """Views of the engine arrays that are set in every time step."""

    ctrl: np.ndarray
    qacc_warmstart: np.ndarray

"""How kernels are compiled, in one place: ahead of the loop, cached on disk, without the GIL."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a module-level function with Numba.

    Strict floating point (no ``fastmath``): a replay must give the live run's bits, and NaN must stay NaN.
    """
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))

"""One BLAS thread for calculations whose matrices are small."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
T = TypeVar("T")


def on_one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function during whose calls BLAS uses one thread.

    The matrices are small, so several threads wait for each other: if other programs use the cores
    too, for ten times as long as the calculation takes. The last digits of results would also
    depend on their number.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited

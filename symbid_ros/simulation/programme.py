"""ProxQP in the build whose digits do not depend on where in memory its vectors lie.

proxsuite takes the widest build that the processor knows. Those for AVX round otherwise where a
vector is not aligned to 32 or 64 bytes, which differs from process to process: two runs with equal
seeds would part by 1e-6 Nm. Programmes of twenty unknowns are solved no slower without.
"""

import sys
from types import ModuleType


def _never() -> bool:
    return False


class _NoWideVectors(ModuleType):
    """What proxsuite asks about the processor, while it is imported."""

    has_AVX512F = staticmethod(_never)  # noqa: N815 (proxsuite's names)
    has_AVX2 = staticmethod(_never)  # noqa: N815


sys.modules.setdefault("proxsuite.instructionset", _NoWideVectors("proxsuite.instructionset"))

from proxsuite import proxqp  # noqa: E402 (which build it is has been settled above)

__all__ = ["proxqp"]

"""How threads share work in compiled code: whoever is free claims the next item, and nobody waits for Python."""

from __future__ import annotations

from numba import types
from numba.extending import intrinsic


@intrinsic
def claim(typing, counter):  # type: ignore[no-untyped-def]
    """The integer in an array (1,), which is one more afterwards, whoever else asks at the same time (atomic)."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.atomic_rmw("add", array.data, context.get_constant(types.intp, 1), "monotonic")

    return types.intp(counter), generate

"""Check that a mapping keeps to the contract, on a few responses, before anything is trained."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from animat.coding.mapping import N_PERCENTILES, Mapping
from animat.errors import InvalidArgument, first_line, shown
from animat.lazy import jax

_RESPONSES_HZ = np.append(np.arange(0.0, 12.0, 0.5), 10_000.0).astype(np.float32)
"""The last is far above all percentiles, as a burst may be in a closed loop."""
_PERCENTILES_HZ = {
    "": np.linspace(1.0, 11.0, N_PERCENTILES, dtype=np.float32),
    " where all percentiles are equal": np.full(N_PERCENTILES, 6.0, np.float32),
    " where all percentiles are 0": np.zeros(N_PERCENTILES, np.float32),
}
"""For a culture with varied responses, one whose response is always the same, and a silent one."""
for _array in (_RESPONSES_HZ, *_PERCENTILES_HZ.values()):
    # A mapping that works in place is refused, and the next one checked with the same numbers.
    _array.setflags(write=False)


def check_mapping(mapping: Mapping) -> None:
    """Raise InvalidArgument for a mapping whose results on a few responses, in numpy and JAX, are not commands."""
    if not isinstance(mapping, Mapping):
        raise InvalidArgument(f"mapping: expected a mapping or the name of one, got {shown(mapping)}")
    try:
        hash(mapping)
    except Exception as error:
        expected = f"{type(mapping).__name__}: expected a frozen dataclass of plain parameters"
        raise InvalidArgument(f"{expected} ({first_line(error)})") from error
    _check_commands(mapping)


@lru_cache(maxsize=64)
def _check_commands(mapping: Mapping) -> None:
    """Cached, as each mapping is compiled."""
    expected, n, compiled = f"{type(mapping).__name__}.command: expected", len(_RESPONSES_HZ), jax.jit(mapping.command)
    for where, percentiles in _PERCENTILES_HZ.items():
        u = _results(mapping.command, _RESPONSES_HZ, percentiles, f"{expected} commands")
        if u.shape != (n,) or u.dtype.kind not in "fiu":
            raise InvalidArgument(f"{expected} {n} commands from -1 to 1{where}, got {shown(u.tolist())}")
        # Also true for NaN.
        if wrong := np.flatnonzero(~(np.abs(u) <= 1)).tolist():
            i = wrong[0]
            raise InvalidArgument(f"{expected} commands from -1 to 1{where}, got {u[i]:g} at {_RESPONSES_HZ[i]:g} Hz")
        if falls := np.flatnonzero(np.diff(u) < 0).tolist():
            i = falls[0]
            falls_hz = f"{u[i]:g} at {_RESPONSES_HZ[i]:g} Hz and {u[i + 1]:g} at {_RESPONSES_HZ[i + 1]:g} Hz"
            raise InvalidArgument(f"{expected} commands that never fall as the response rises{where}, got {falls_hz}")
        for i in (0, -1):
            one = _results(mapping.command, _RESPONSES_HZ[i], percentiles, f"{expected} commands")
            if one.shape != () or one != u[i]:
                same = f"the same command for a single response as in an array, {u[i]:g}"
                raise InvalidArgument(f"{expected} {same}, got {shown(one.tolist())}")
        # Training computes commands under `jax.jit`, and a closed loop in numpy.
        hint = ": use functions of namespace_of(x), and where in place of if"
        same = _results(compiled, _RESPONSES_HZ, percentiles, f"{expected} it to run under jax.jit", hint)
        if same.shape != u.shape:
            raise InvalidArgument(f"{expected} {n} commands under jax.jit too, got {shown(same.tolist())}")
        if not np.allclose(same, u, atol=1e-4):
            i = int(np.argmax(np.abs(same - u)))
            numpys = f"{u[i]:g} for {_RESPONSES_HZ[i]:g} Hz"
            raise InvalidArgument(f"{expected} the same under jax.jit as in numpy{where}, {numpys}, got {same[i]:g}")


def _results(command: Callable[..., Any], x: Any, percentiles: Any, expected: str, hint: str = "") -> Any:
    try:
        # The result of a division by zero is checked, and reported in one line.
        with np.errstate(all="ignore"):
            return np.asarray(command(x, percentiles))
    except Exception as error:
        # Anything may go wrong in a third-party mapping.
        raise InvalidArgument(f"{expected}, got {first_line(error)}{hint}") from error

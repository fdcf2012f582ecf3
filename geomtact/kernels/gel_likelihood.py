"""How likely contacts are whose energies are known, on a gel that is not known."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


def gel_log_likelihood(energy: NDArray[np.float32], rate: float, log_share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log of the mean of exp(-rate energy) over the gels (n,), at n poses; -inf where energies are inf.

    Parameters
    ----------
    energy : (n, SHARES) as ``contact_energy`` gives them
    rate : [nats for each unit of energy]
    log_share : (SHARES,) log probability of each share of the depth
    """
    out = np.empty(len(energy))
    _gel_log_likelihood(energy, rate, log_share, out)
    return out


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _gel_log_likelihood(energy, rate, log_share, out):  # type: ignore[no-untyped-def]
    """The loop of :func:`gel_log_likelihood`, which writes ``out``."""
    for i in range(len(out)):
        if not np.isfinite(energy[i, 0]):
            out[i] = -np.inf
            continue
        most = -np.inf
        for j in range(len(log_share)):
            most = max(most, log_share[j] - rate * energy[i, j])
        total = 0.0
        for j in range(len(log_share)):
            total += np.exp(log_share[j] - rate * energy[i, j] - most)
        out[i] = most + np.log(total)

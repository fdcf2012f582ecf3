"""The leading poses of one contact told apart by its outline, where few enough cells are left to look into each.

Of the likeliest cells, poses are drawn, registered and cast as for several sensors (``search``). The most hopeful are then moved
and weighed by how far the outline that was observed is from those that rigid and elastic gels would show there (``gels``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.inference.gels import ROUNDS, Gel
from geomtact.inference.posterior import Posterior
from geomtact.inference.search import Search, View

_CELLS = 600  # that are looked into
ENOUGH = 0.1  # share of the posterior that these must hold, to be worth it
# Power of what a cell had, for the image that told it is the outline's; the share of their mass that the cells weighed keep,
# whatever is likely within them; and that all others keep
_BEFORE, _DOUBT, _ELSEWHERE = 0.5, 0.15, 0.5


def few_are_left(posterior: Posterior) -> bool:
    """Whether the cells that would be looked into hold enough of a posterior."""
    cells = posterior.likeliest_cells(_CELLS)
    return bool(np.exp(posterior.cell_log_density(cells) + posterior.index.log_weight[cells]).sum() > ENOUGH)


def refine_by_outline(
    posterior: Posterior, view: View, k: int, seed: int, log_prior: NDArray[np.floating] | None = None
) -> Posterior:
    """``posterior`` with its leading modes refined against the outline of the contact in ``view``, and weighed anew by it;
    ``settings["by_outline"]`` says so.

    Parameters
    ----------
    k : how many modes are wanted
    log_prior : as of ``Posterior.shared_anew``
    """
    search = Search(posterior, [view], np.random.default_rng(seed))
    tried = search.registered(search.drawn(posterior.likeliest_cells(_CELLS)), thorough=True)
    _, poses, likely = search.best_of_each_cell(search.around_the_best(tried))
    if not len(poses):
        return posterior
    hopeful = np.argsort(-likely, kind="stable")[: ROUNDS[0][0]]
    gel = Gel.showing(view.mask, view.refinery.space)
    T, likely = gel.search(poses[hopeful], search.width, search.problem, search.rng)
    home, T, likely = search.by_cell(T, likely)
    posterior = posterior.shared_anew(home, likely, _DOUBT, _ELSEWHERE, _BEFORE, log_prior)
    told_at = search.told(posterior, home, T, k)
    return replace(posterior, refined=told_at, settings=posterior.settings | {"by_outline": True})

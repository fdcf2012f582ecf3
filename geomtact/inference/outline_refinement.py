"""The leading modes of one contact refined by its outline, where few enough cells are left to search each.

Of the likeliest cells, poses are drawn, registered and cast as for several sensors (``search``). The best are then refined and
reweighted by how far the observed outline is from those that rigid and elastic gels would show there (``gels``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.inference.distribution import cell_log_density, likeliest_cells
from geomtact.inference.gels import ROUNDS, Gel
from geomtact.inference.posterior import Posterior
from geomtact.inference.reweight import reweight_cells
from geomtact.inference.search import Search, SensorView

_CELLS = 600  # number of cells that are searched; hand-set
ENOUGH = 0.1  # least share of the posterior in these cells for which the search pays; hand-set
# Arguments of ``reweight_cells``, hand-set: the outline comes from the image that gave the cells their mass, so that mass gets
# the power one half.
_IMAGE_POWER, _KEPT_SHARE, _OTHERS_FACTOR = 0.5, 0.15, 0.5


def few_are_left(posterior: Posterior) -> bool:
    """Whether the cells that would be searched hold enough of a posterior."""
    cells = likeliest_cells(posterior, _CELLS)
    return bool(np.exp(cell_log_density(posterior, cells) + posterior.index.log_weight[cells]).sum() > ENOUGH)


def refine_by_outline(
    posterior: Posterior, view: SensorView, k: int, seed: int, log_prior: NDArray[np.floating] | None = None
) -> Posterior:
    """``posterior`` with its leading modes refined against the outline of the contact in ``view``, and weighed again by it.

    Parameters
    ----------
    k : number of modes to refine
    log_prior : as of ``reweight_cells``
    """
    search = Search(posterior, [view], np.random.default_rng(seed))
    candidates = search.registered(search.drawn(likeliest_cells(posterior, _CELLS)), thorough=True)
    _, poses, likely = search.best_of_each_cell(search.around_the_best(candidates))
    if not len(poses):
        return posterior
    hopeful = np.argsort(-likely, kind="stable")[: ROUNDS[0][0]]
    gel = Gel.showing(view.mask, view.refiner.space)
    T, likely = gel.search(poses[hopeful], search.width, search.problem, search.rng)
    home, T, likely = search.by_cell(T, likely)
    posterior = reweight_cells(posterior, home, likely, _KEPT_SHARE, _OTHERS_FACTOR, _IMAGE_POWER, log_prior)
    diagnostics = replace(posterior.diagnostics, refined_by_outline=True)
    return replace(posterior, refined=search.refined(posterior, home, T, k), diagnostics=diagnostics)

"""One touch compared with every pose of an index: geomtact's scores against the exact and the quantised indexes of faiss."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from typing import Any

import numpy as np
from benchmark import spread
from peerbench.turns import Way, take_turns

TEN = 10
SORTED = 3  # touches for which faiss sorts all poses: that takes long
ALIKE = 1e-4  # squared distances of vectors that are equal but for rounding


def retrieval(given: argparse.Namespace) -> list[dict[str, Any]]:
    from geomtact.contact_space.touches import random_touches
    from geomtact.localizer import Localizer

    localizer = Localizer.prepare(given.part, sensor=given.sensor)
    index = localizer.index
    masks = [touch.mask for touch in random_touches(localizer.space, given.touches + 1, given.seed)]
    rows = []
    for score in ("encoder", "cosine", "l1"):
        ways, alike = (bit_ways if score == "l1" else vector_ways)(index, score, given.threads)

        def judge(own: Any, answer: Any, alike: float = alike) -> dict[str, Any]:
            if len(answer) > TEN:
                return {"largest_difference": float(np.abs(answer - own).max())}
            return {"of_ten_best": float((own[answer] >= np.partition(own, -TEN)[-TEN] - alike).mean())}

        take_turns(ways, masks, judge)
        for way in ways:
            row = {"threads": given.threads, "score": score, "poses": len(index), "method": way.method}
            row |= {"touches": len(way.ms), "ms": spread(way.ms), "bytes": way.bytes}
            row["gb_per_s"] = way.bytes / row["ms"]["median"] / 1e6
            for what, of in (("of_ten_best", np.mean), ("largest_difference", np.max)):
                if what in way.verdicts[0]:
                    row[what] = float(of([verdict[what] for verdict in way.verdicts]))
            rows.append(row)
    return rows


def own_ways(score: Callable[[Any], Any], size: float, threads: int) -> list[Way]:
    """The scores of all poses by geomtact, the ten best of them, and as a bound a mere look at so many bytes."""
    parts, pool = np.array_split(np.ones(int(size) // 4, np.float32), threads), ThreadPoolExecutor(threads)
    return [
        Way("geomtact, all", score, size),
        Way("geomtact, ten best", lambda mask: np.argpartition(score(mask), -TEN)[-TEN:], size),
        Way("largest of as many numbers", lambda _: list(pool.map(np.max, parts)) and None, size),
    ]


def vector_ways(index: Any, name: str, threads: int) -> tuple[list[Way], float]:
    """Variants of comparing vectors: the network's by their distance, small images by their cosine."""
    from geomtact.contact_space.store import default_cache_dir
    from geomtact.scoring.catalogue import descriptor_of, fingerprint
    from geomtact.scoring.vectors import describe_index

    found = descriptor_of(name, index)
    assert found is not None
    descriptor, compared = found
    kept = default_cache_dir() / index.key / f"{descriptor.name}-{fingerprint(descriptor)}.npy"
    stored = describe_index(index, descriptor, kept)
    scorer = compared(descriptor, stored)
    ways = own_ways(lambda mask: scorer.score(index, mask).ravel(), stored.nbytes, threads)
    if not find_spec("faiss"):
        return ways, ALIKE
    import faiss

    cosine, n, d = name == "cosine", *stored.shape
    metric = faiss.METRIC_INNER_PRODUCT if cosine else faiss.METRIC_L2
    exact = faiss.IndexFlatIP(d) if cosine else faiss.IndexFlatL2(d)
    half = faiss.IndexScalarQuantizer(d, faiss.ScalarQuantizer.QT_fp16, metric)
    byte = faiss.IndexScalarQuantizer(d, faiss.ScalarQuantizer.QT_8bit, metric)
    for made in (exact, half, byte):
        made.train(stored)
        made.add(stored)

    def query(mask: Any) -> Any:
        return scorer.seen(index, mask)[None]

    def score(found: Any, seen: Any) -> Any:  # minus the squared distance; a contact too small to be seen has no length
        return 2 * found - 1 - np.square(seen).sum() if cosine else -found

    ways += faiss_ways(exact, query, score, 4 * n * d, -2.0 if cosine else 1e30)
    ways += [ten_way("fp16", half, query, 2 * n * d), ten_way("8 bit", byte, query, n * d)]
    return ways, ALIKE


def bit_ways(index: Any, name: str, threads: int) -> tuple[list[Way], float]:
    """Variants of counting the pixels in which packed masks differ."""
    from geomtact.scoring import overlap

    overlap._THREADS = threads
    scorer, shape = overlap.OVERLAPS[name], index.resolution.mask_shape
    pixels = shape[0] * shape[1]
    ways = own_ways(lambda mask: scorer.score(index, mask).ravel(), index.bits.nbytes, threads)
    if find_spec("faiss"):
        import faiss

        flat = faiss.IndexBinaryFlat(pixels)
        flat.add(np.ascontiguousarray(index.bits.transpose(0, 2, 1)).reshape(len(index), -1).view(np.uint8))

        def query(mask: Any) -> Any:
            return np.packbits(overlap.to_grid(mask, shape).ravel())[None]

        ways += faiss_ways(flat, query, lambda found, _: 1 - found / np.float32(pixels), index.bits.nbytes, pixels + 1)
    return ways, 0.5 / pixels


def ten_way(label: str, made: Any, query: Callable[[Any], Any], size: float) -> Way:
    name = type(made).__name__.removeprefix("Index")
    return Way(f"faiss {name}{label and f' {label}'}, ten best", lambda m: made.search(query(m), TEN)[1][0], size)


def faiss_ways(made: Any, query: Any, score: Any, size: float, radius: float) -> list[Way]:
    """The ten best by an exact index of faiss, and the scores of all its poses, in their order."""

    def ordered(ids: Any, found: Any, seen: Any) -> Any:
        out = np.empty(made.ntotal, np.float32)
        out[ids] = score(found, seen)
        return out

    def within(mask: Any) -> Any:
        seen = query(mask)
        _, found, ids = made.range_search(seen, radius)
        return ordered(ids, found, seen)

    def search(mask: Any) -> Any:
        seen = query(mask)
        found, ids = made.search(seen, made.ntotal)
        return ordered(ids[0], found[0], seen)

    ten = ten_way("", made, query, size)
    name = ten.method.removesuffix(", ten best")
    return [ten, Way(f"{name}, all by range_search", within, size), Way(f"{name}, all by search", search, size, SORTED)]

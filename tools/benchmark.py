"""What geomtact costs on this machine.

    python tools/benchmark.py --out docs/results/benchmark.json

Prints medians and spreads and writes them to a JSON file with the machine's facts. Indexes are built in a folder of
their own, which is removed afterwards; --keep names one that stays. Run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

PART, SENSOR = "damping_pin", "gelslim"
THESIS_POSES = 150_000
ROTATIONS = 40  # poses whose casts make the rate of rays


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", default=PART)
    parser.add_argument("--sensor", default=SENSOR)
    parser.add_argument("--repeats", type=int, default=20, help="touches localized, and starts of the command line / 4")
    parser.add_argument("--keep", type=Path, help="cache folder to use and keep; an index in it is not built anew")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    given = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as scratch:
        cache = given.keep or Path(scratch)
        figures = {"machine": machine(), "rays": rays(given.part, given.sensor)}
        figures["prepare"] = in_process("prepare", given.part, given.sensor, cache)
        figures["kernels"] = in_process("kernels", given.part, given.sensor, cache)
        figures["localize_warm"] = in_process("localize", given.part, given.sensor, cache, given.repeats)
        figures["several"] = in_process("several", given.part, given.sensor, cache, given.repeats)
        figures["start"] = starts(given.part, given.sensor, cache, max(3, given.repeats // 4))
    figures["machine"]["load_before"] = load
    show(figures)
    if given.out:
        write(figures, given.out)


def write(figures: dict[str, Any], path: Path) -> None:
    """The figures as a JSON file."""
    from geomtact.files import write_whole

    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda temporary: temporary.write_text(json.dumps(figures, indent=1) + "\n", "utf-8"))


def machine() -> dict[str, Any]:
    """Facts that the figures depend on, with what torch computes in on this processor."""
    import torch

    from geomtact.scoring.precision import fastest_precision
    from geomtact.versions import versions

    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": model,
        "cores": cores,
        "capability": torch.backends.cpu.get_cpu_capability(),
        "precision": str(fastest_precision()).removeprefix("torch."),
        "system": platform.platform(),
        "versions": versions(),
    }


def rays(part: str, sensor_name: str) -> dict[str, Any]:
    """Camera rays per second against the object, one thread and two."""
    from geomtact.contact_space.space import ContactSpace
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.sensing.cast import Caster
    from geomtact.sensing.sensor import Sensor

    sensor = Sensor.load(sensor_name)
    mesh = load_mesh(part, sensor=sensor)
    T, _ = ContactSpace(mesh, sensor).sample(ROTATIONS, np.random.default_rng(0))
    n = ROTATIONS * sensor.image_size_px[0] * sensor.image_size_px[1]
    out: dict[str, Any] = {"part": part, "faces": len(mesh.faces)}
    for threads in (1, 2):
        caster = Caster(mesh.vertices, mesh.faces, threads)
        out[f"per_second_{threads}_threads"] = n / float(np.median(timed(lambda c=caster: c.depths(sensor, T), 5)))
    return out


def in_process(what: str, *args: Any) -> dict[str, Any]:
    """One of ``_MEASURED`` in a separate process, so that peak memory is its own."""
    command = [sys.executable, __file__, f"--{what}", *map(str, args)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def _prepare(part: str, sensor: str, cache: str) -> dict[str, Any]:
    import resource

    from geomtact.contact_space.store import open_index
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.localizer import Localizer
    from geomtact.sensing.sensor import Sensor

    began = time.perf_counter()
    pressed = Sensor.load(sensor)
    mesh = load_mesh(part, sensor=pressed)
    index = open_index(mesh, pressed, cache_dir=cache)
    built = time.perf_counter()
    Localizer.prepare(mesh, sensor=sensor, cache_dir=cache)
    ready = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {
        "part": part,
        "sensor": sensor,
        "faces": len(mesh.faces),
        "poses": len(index),
        "index_s": built - began,
        "calibration_s": ready - built,
        "prepare_s": ready - began,
        "poses_per_second": len(index) / (built - began),
        "index_bytes_per_pose": index.bytes_per_pose,
        "peak_bytes": peak,
    }


def _localize(part: str, sensor: str, cache: str, repeats: str) -> dict[str, Any]:
    """Each touch at every effort, and by the thesis's query, in turn: all of them meet the same neighbours."""
    from geomtact.contact_space.touches import random_touches
    from geomtact.inference.effort import EFFORTS
    from geomtact.localizer import Localizer

    localizer = Localizer.prepare(part, sensor=sensor, cache_dir=cache)
    touches = random_touches(localizer.space, int(repeats), seed=0)
    query = thesis_query(localizer.sensor)
    for touch in touches[:2]:
        for effort in EFFORTS:
            localizer.localize(touch.mask, kind="mask", effort=effort).modes(5)
        query(touch.mask)
    ms: dict[str, list[float]] = {}
    refined: dict[str, int] = {}

    def note(what: str, began: float) -> None:
        ms.setdefault(what, []).append(1e3 * (time.perf_counter() - began))

    for touch in touches:
        for effort in EFFORTS:
            began = time.perf_counter()
            posterior = localizer.localize(touch.mask, kind="mask", effort=effort)
            note(effort, began)
            refined[effort] = len(posterior.refined)
            for stage, took in posterior.timing_ms.items():
                ms.setdefault(f"{effort}, {stage}", []).append(took)
            began = time.perf_counter()
            posterior.modes(5)
            note(f"{effort}, modes after it", began)
        began = time.perf_counter()
        query(touch.mask)
        note("the thesis's query", began)
    return {
        "poses": len(localizer.index),
        "touches": len(touches),
        "refined_modes": refined,
        "balanced_over_thesis_query": float(np.median(np.divide(ms["balanced"], ms["the thesis's query"]))),
        "ms": {what: spread(took) for what, took in ms.items()},
    }


def _several(part: str, sensor: str, cache: str, repeats: str) -> dict[str, Any]:
    """Scenes of two and three sensors, a third as many as touches, by `fast` and `balanced` in turn."""
    from geomtact.evaluation import localized, simultaneous_touches
    from geomtact.localizer import Localizer

    localizer = Localizer.prepare(part, sensor=sensor, cache_dir=cache)
    scenes = list(simultaneous_touches(localizer.space, max(3, int(repeats) // 3) + 1, 3, seed=0))
    ms: dict[str, list[float]] = {}
    for number, scene in enumerate(scenes):
        for sensors in (2, 3):
            for effort in ("fast", "balanced"):
                took = localized(localizer, scene, sensors, effort=effort)[1]
                if number and took:  # the first scene warms up
                    ms.setdefault(f"{sensors} sensors, {effort}", []).append(took)
    return {"scenes": len(scenes) - 1, "ms": {what: spread(took) for what, took in ms.items()}}


def _kernels(part: str, sensor: str, cache: str) -> dict[str, Any]:
    """Each kernel on all threads: how much it does in a second, the limit that was measured here, and the share reached."""
    import torch

    from geomtact.contact_space.contact_maps import ContactMaps, located
    from geomtact.contact_space.touches import random_touches
    from geomtact.localizer import Localizer
    from geomtact.scoring.contact_likelihood import SHAPE, ContactQuery
    from geomtact.scoring.encoder import Tower
    from geomtact.scoring.precision import autocast

    localizer = Localizer.prepare(part, sensor=sensor, cache_dir=cache)
    index, rng = localizer.index, np.random.default_rng(0)
    T, masks = zip(*((t.T_sensor_object, t.mask) for t in random_touches(localizer.space, 40, seed=0)), strict=True)
    poses, membrane = located(index, np.repeat(T, 250, 0))
    image = masks[0].astype(np.float32)
    query = ContactQuery.of(image, index.sensor)
    heights = ContactMaps.of(index).maps.heights[0].ravel()
    pixels = rng.integers(len(heights), size=(1000, SHAPE[0] * SHAPE[1]))

    scorer: Any = localizer.scorer.scorer
    tower, stored = scorer.descriptor, scorer.stored
    assert isinstance(tower, Tower)
    shown = np.zeros((16_384, 24, 32), bool)
    shown[:, 6:18, 8:24] = rng.random((len(shown), 12, 16)) < 0.5
    multiplied = sum(w.size for name, w in tower.weights.items() if w.ndim == 2 and "touch" not in name)
    a = torch.randn(4096, 1024)
    with torch.inference_mode(), autocast():
        product = len(a) * 1024 * 1024 / best(lambda: a @ a[:1024].T)
    return {
        "cut and compare contacts": {
            "per_second": len(membrane) / best(lambda: query.compare(index, poses, membrane)),
            "of": "contacts",
            "limit": len(pixels) / best(lambda: heights.take(pixels)),
            "limited by": "heights gathered by numpy, one thread",
        },
        "encode contacts": {
            "per_second": len(shown) / best(lambda: tower.describe(shown, index.sensor)),
            "of": "contacts",
            "limit": product / multiplied,
            "limited by": "a matrix product in the same precision",
        },
        "score all poses": {
            "per_second": len(stored) / best(lambda: scorer.score(index, image)),
            "of": "poses",
            "limit": len(stored) / best(stored.max),
            "limited by": "the largest of all numbers, by numpy",
        },
    }


def best(what: Callable[[], Any]) -> float:
    """The least of the seconds that seven calls take: what the machine can do."""
    return min(timed(what, 7))


def thesis_query(sensor: Any) -> Callable[[Any], Any]:
    """The thesis's comparison of a mask with 150,000 stored contacts: a ResNet-50 forward and a cosine with 1,000 numbers
    each. Its time does not depend on what the weights are, so they are random."""
    import torch

    from geomtact.scoring.resnet import NUMBERS, SIDE, Resnet, make_network

    torch.manual_seed(0)
    network = Resnet(make_network().eval(), SIDE, "random")
    stored = np.random.default_rng(0).standard_normal((THESIS_POSES, NUMBERS), np.float32)
    return lambda mask: np.maximum(stored @ network.describe(mask[None], sensor)[0], 0)


def starts(part: str, sensor: str, cache: Path, repeats: int) -> dict[str, Any]:
    """Wall time of whole processes, first to last line."""
    from PIL import Image

    from geomtact.contact_space.touches import random_touches
    from geomtact.localizer import Localizer

    with tempfile.TemporaryDirectory() as folder:
        image = Path(folder) / "touch.png"
        touch = random_touches(Localizer.prepare(part, sensor=sensor, cache_dir=cache).space, 1, seed=0)[0]
        Image.fromarray(255 * touch.mask.astype(np.uint8)).save(image)
        python, run = sys.executable, [sys.executable, "-m", "geomtact"]
        localize = [*run, "localize", str(image), "--object", part, "--sensor", sensor, "--cache-dir", str(cache)]
        commands = {
            "import_geomtact_s": [python, "-c", "import geomtact"],
            "help_s": [*run, "--help"],
            "localize_s": localize,
            "localize_with_report_s": [*localize, "--out", str(Path(folder) / "out")],
        }

        def start(command: list[str]) -> None:
            subprocess.run(command, check=True, capture_output=True)

        return {name: spread(timed(lambda c=c: start(c), repeats)) for name, c in commands.items()}


def timed(what: Callable[[], Any], repeats: int) -> list[float]:
    """Seconds that each of ``repeats`` calls takes, after one that is not counted."""
    what()
    out = []
    for _ in range(repeats):
        began = time.perf_counter()
        what()
        out.append(time.perf_counter() - began)
    return out


def spread(values: list[float]) -> dict[str, float]:
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9))
    return {"median": float(median), "10 %": float(low), "90 %": float(high)}


def show(figures: dict[str, Any]) -> None:
    facts, cast, made, warm = (figures[k] for k in ("machine", "rays", "prepare", "localize_warm"))
    print(
        f"{facts['processor']} ({facts['capability']}, networks in {facts['precision']}), {facts['cores']} cores, "
        f"load {facts['load_before']:.1f} before the run"
    )
    rate = " and ".join(f"{cast[f'per_second_{t}_threads'] / 1e6:.1f} M/s ({t} threads)" for t in (1, 2))
    print(f"rays at {cast['part']} ({cast['faces']} faces): {rate}")
    print(
        f"prepare: {made['poses']} poses in {made['index_s']:.1f} s ({made['poses_per_second']:.0f} a second), "
        f"calibration {made['calibration_s']:.1f} s, peak {made['peak_bytes'] / 1e9:.2f} GB, "
        f"{made['index_bytes_per_pose']:.0f} bytes a pose"
    )
    print(f"localize warm, {warm['poses']} poses, {warm['refined_modes']} refined modes [ms]: median (10 % to 90 %)")
    for what, ms in warm["ms"].items():
        print(f"  {what:26} {ms['median']:7.1f} ({ms['10 %']:.1f} to {ms['90 %']:.1f})")
    print(f"  balanced takes {warm['balanced_over_thesis_query']:.2f} of the time of the thesis's query")
    print(f"several sensors, {figures['several']['scenes']} scenes [ms]: median (10 % to 90 %)")
    for what, ms in figures["several"]["ms"].items():
        print(f"  {what:26} {ms['median']:7.0f} ({ms['10 %']:.0f} to {ms['90 %']:.0f})")
    print("kernels [million a second], the limit, and the share of it that is reached")
    for what, one in figures["kernels"].items():
        share = 100 * one["per_second"] / one["limit"]
        print(
            f"  {what:26} {one['per_second'] / 1e6:7.2f} {one['limit'] / 1e6:8.2f} {share:4.0f} %  ({one['limited by']})"
        )
    print("cold processes [s]: median (10 % to 90 %)")
    for name, s in figures["start"].items():
        print(f"  {name:24} {s['median']:.2f} ({s['10 %']:.2f} to {s['90 %']:.2f})")


_MEASURED = {"prepare": _prepare, "kernels": _kernels, "localize": _localize, "several": _several}

if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1].removeprefix("--") in _MEASURED:
        print(json.dumps(_MEASURED[sys.argv[1].removeprefix("--")](*sys.argv[2:])))
    else:
        main()

"""geomtact against peers: one touch sought among all poses, against faiss; depth images, against Open3D and pyrender.

    pip install -c tools/constraints.txt '.[bench]'
    python tools/peers.py --out docs/results/peers.json

A peer that is missing is named, and the other rows still come. Methods take turns on every
touch and every few poses, so all meet the same neighbours. Medians and spreads are printed and written to a JSON file.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmark import machine, write
from peerbench.retrieval import retrieval
from peerbench.simulation import simulation

from geomtact.versions import versions

PIP = {"faiss": "faiss-cpu", "pyrender": "pyrender"}
THREADS = (1, 2)
OPEN = "import pyrender; pyrender.OffscreenRenderer(8, 8); from OpenGL.GL import *; print(glGetString(GL_RENDERER).decode())"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", default="damping_pin")
    parser.add_argument("--sensor", default="gelslim", help="one with a camera and a flat gel")
    parser.add_argument("--touches", type=int, default=20)
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--child", choices=("retrieval", "simulation"), help=argparse.SUPPRESS)
    parser.add_argument("--threads", type=int, default=1, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        print(json.dumps(retrieval(given) if given.child == "retrieval" else simulation(given)))
        return
    settings = {name: getattr(given, name) for name in ("part", "sensor", "touches", "poses", "seed")}
    facts, missing = machine() | {"load_before": os.getloadavg()[0]}, absent()
    facts["opengl"] = opengl(missing)
    facts["versions"] |= versions(*PIP.values())
    figures: dict[str, Any] = {"machine": facts, "settings": settings, "missing": missing}
    for child in ("retrieval", "simulation"):
        figures[child] = [row for n in THREADS for row in in_process(child, n, settings)]
    show(figures)
    if given.out:
        write(figures, given.out)


def absent() -> dict[str, str]:
    """Which peers are not installed, and what to do."""
    return {name: f"{name} is not installed; pip install {pip}" for name, pip in PIP.items() if not find_spec(name)}


def opengl(missing: dict[str, str]) -> str:
    """What draws for pyrender, set up for it; "none" where nothing does, which is noted in ``missing``."""
    if "pyrender" in missing:
        return "none"
    for platform in ("egl", "osmesa"):
        os.environ["PYOPENGL_PLATFORM"] = platform
        tried = subprocess.run([sys.executable, "-c", OPEN], capture_output=True, text=True)
        if tried.returncode == 0:
            missing.pop("pyrender", None)
            return tried.stdout.strip()
        why = (tried.stderr.strip().splitlines() or ["it crashed"])[-1]
        missing.setdefault("pyrender", f"pyrender cannot draw here ({platform}: {why}); apt-get install libegl1")
    del os.environ["PYOPENGL_PLATFORM"]
    return "none"


def in_process(child: str, threads: int, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of ``retrieval`` or ``simulation`` with ``threads`` threads, which libraries read when they are loaded."""
    few = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
    few["LP_NUM_THREADS"] = str(threads if threads > 1 else 0)  # of Mesa's llvmpipe; 0 leaves it the caller's
    command = [sys.executable, __file__, "--child", child, "--threads", str(threads)]
    command += [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | few)
    return json.loads(done.stdout.splitlines()[-1])


def show(figures: dict[str, Any]) -> None:
    facts = figures["machine"]
    print(f"{facts['processor']}, {facts['cores']} cores, load {facts['load_before']:.1f} before the run")
    for why in figures["missing"].values():
        print(f"{why}; its rows are left out", file=sys.stderr)
    print("one touch among all poses: threads, score, method [ms], median (10 % to 90 %)")
    for row in figures["retrieval"]:
        ms, said = row["ms"], ""
        if "of_ten_best" in row:
            said = f"{100 * row['of_ten_best']:.0f} % of its ten are among the best"
        elif "largest_difference" in row:
            said = f"scores differ by {row['largest_difference']:.0e} at most"
        time_ms = f"{ms['median']:8.2f} ({ms['10 %']:.2f} to {ms['90 %']:.2f})"
        print(f"{row['threads']} {row['score']:8}{row['method']:44}{time_ms:30}{row['gb_per_s']:5.1f} GB/s  {said}")
    print("depth images: threads, pixels, method [ms an image]")
    for row in figures["simulation"]:
        ms, said = row["ms_per_image"], f"{row['rays_per_s'] / 1e6:5.1f} M rays/s"
        if "median_um" in row:
            ppm = (f"{1e6 * row[what]:.1f}" for what in ("over_1_um", "unlike_hits", "unlike_contact"))
            said += f", off by {row['median_um']:.3f} um, at most {row['largest_um']:.1f}; of a million pixels "
            said += "{} are off by 1 um, {} hit and {} touch for one alone".format(*ppm)
        time_ms = f"{ms['median']:7.2f} ({ms['10 %']:.2f} to {ms['90 %']:.2f})"
        print(f"{row['threads']} {'x'.join(map(str, row['pixels'])):8}{row['method']:22}{time_ms:26}{said}")


if __name__ == "__main__":
    main()

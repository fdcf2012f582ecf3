"""How many threads there are changes how long work takes, and nothing else."""

import subprocess
import sys

import pytest

from geomtact.threads import thread_count

TOUCH = """
from geomtact import Localizer
localizer = Localizer.prepare("hex_nut", sensor="gelsight-mini", max_poses=3000, cache_dir={cache!r})
pose = localizer.space.sample(1, __import__("numpy").random.default_rng(0))[0][0]
posterior = localizer.localize(localizer.simulate(pose).mask, "mask", effort="fast")
print(posterior.entropy_nats.hex(), posterior.modes(1)[0].T.tobytes().hex())
"""


@pytest.mark.parametrize(("stated", "count"), [("1", 1), ("3", 3), ("64", 8)])
def test_as_many_as_stated(monkeypatch, stated, count):
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    assert thread_count() == count


@pytest.mark.parametrize("stated", ["", "0", "4,2", "many"])
def test_else_as_many_as_processors(monkeypatch, stated):
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    some = thread_count()
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert 1 <= some == thread_count() <= 8


@pytest.mark.slow
def test_results_are_the_same_to_the_last_bit(tmp_path, monkeypatch):
    found = []
    for stated in ("1", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", stated)
        code = TOUCH.format(
            cache=str(tmp_path / "cache")
        )  # the index is built once: torch's own sums depend on its threads
        found.append(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert found[0] == found[1] != ""

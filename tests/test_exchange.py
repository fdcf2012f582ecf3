"""Poses go to other tools and come back the same; a covariance is the same in their order and frame."""

from types import SimpleNamespace

import numpy as np
import pytest

from geomtact import InputError, se3
from geomtact.report.exchange import from_bop, from_tum, to_bop, to_ros, to_table, to_tum

INFINITE = ["nan 1 2 3 0 0 0 1", "0 1 2 inf 0 0 0 1", "0 1 2 3 0 0 NaN 1", "0 1 2 3 0 0 0 -Inf", "0 1e400 2 3 0 0 0 1"]
BOP_LINE = "scene_id,im_id,obj_id,score,R,t,time\n1,1,1,{},1 0 0 0 1 0 0 0 1,{},{}\n"


@pytest.fixture
def poses(rng):
    return se3.transform(se3.random_rotations(5, rng), rng.uniform(-0.3, 0.3, (5, 3)))


def test_a_trajectory_comes_back(poses, tmp_path):
    to_tum(tmp_path / "a.txt", np.arange(5) / 30, poses)
    times, back = from_tum(tmp_path / "a.txt")
    np.testing.assert_allclose(times, np.arange(5) / 30, atol=1e-6)
    np.testing.assert_allclose(back, poses, atol=1e-8)


def test_three_digits_and_comments_are_read(poses, tmp_path):
    lines = [" ".join(f"{x:.3f}" for x in (k, *T[:3, 3], *se3.quat_xyzw(T))) for k, T in enumerate(poses)]
    text = "  # an indented comment\n\n" + "".join(f"{line} # a trailing one\n" for line in lines) + "#\n"
    (tmp_path / "a.txt").write_text(text)
    times, back = from_tum(tmp_path / "a.txt")
    assert times.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(back, poses, atol=4e-3)
    (tmp_path / "empty.txt").write_text("# nothing\n")
    assert [each.shape for each in from_tum(tmp_path / "empty.txt")] == [(0,), (0, 4, 4)]


def test_bop_results_come_back(poses, tmp_path):
    rows = [{"scene_id": 1, "im_id": i, "obj_id": 3, "score": 0.25, "time": 0.1, "T": T} for i, T in enumerate(poses)]
    to_bop(tmp_path / "a.csv", rows)
    first = (tmp_path / "a.csv").read_text().splitlines()[1].split(",")
    assert len(first) == 7 and len(first[4].split()) == 9
    np.testing.assert_allclose([float(x) for x in first[5].split()], 1e3 * poses[0, :3, 3], rtol=1e-6)
    for row, back in zip(rows, from_bop(tmp_path / "a.csv"), strict=True):
        np.testing.assert_allclose(back.pop("T"), row.pop("T"), atol=1e-8)
        assert back == row


def test_a_ros_covariance_is_that_of_the_moved_poses(poses, rng):
    """Samples in the object's frame scatter about the mean as the message states: positions, and turns about fixed axes."""
    root = rng.normal(size=(6, 6)) * 1e-3
    mode = SimpleNamespace(T=poses[0], covariance=root @ root.T, probability=0.5)
    message = to_ros(mode, "base", 12.25)
    assert message["header"] == {"stamp": {"sec": 12, "nanosec": 250_000_000}, "frame_id": "base"}
    drawn = mode.T @ se3.exp(rng.multivariate_normal(np.zeros(6), mode.covariance, 100_000))
    turns = se3.log(se3.transform(drawn[:, :3, :3] @ mode.T[:3, :3].T, np.zeros(3)))[:, :3]
    found = np.cov(np.concatenate([drawn[:, :3, 3], turns], 1).T)
    stated = np.reshape(message["pose"]["covariance"], (6, 6))
    np.testing.assert_allclose(found, stated, atol=0.03 * np.abs(stated).max())
    position, q = message["pose"]["pose"]["position"], message["pose"]["pose"]["orientation"]
    assert [position[k] for k in "xyz"] == mode.T[:3, 3].tolist()
    assert [q[k] for k in "xyzw"] == se3.quat_xyzw(mode.T).tolist()


def test_a_table_has_a_row_for_each_mode(poses):
    modes = [
        SimpleNamespace(T=T, covariance=np.diag([0.01, 0.02, 0.03, 1e-3, 2e-3, 3e-3]) ** 2, probability=p)
        for T, p in zip(poses, (0.5, 0.2, 0.1, 0.05, 0.01), strict=True)
    ]
    posterior = SimpleNamespace(mesh=SimpleNamespace(name="pin"), frame="world")
    table = to_table(modes, posterior)
    assert {len(column) for column in table.values()} == {5}
    assert table["x_mm"] == pytest.approx(1e3 * poses[:, 0, 3])
    assert table["shift_std_mm"] == pytest.approx([3] * 5)
    assert table["turn_std_deg"] == pytest.approx([np.degrees(0.03)] * 5)
    assert {len(column) for column in to_table([], posterior).values()} == {0}


@pytest.mark.parametrize(
    ("read", "text", "expected"),
    [
        (from_tum, "0 1 2 3\n", "line 1: expected timestamp tx ty tz qx qy qz qw, eight numbers"),
        (from_tum, "# t\n\n0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 x\n", "line 4: expected timestamp .*, eight numbers"),
        (from_tum, "1_0 1 2 3 0 0 0 1\n", "line 1: expected timestamp .*, eight numbers"),
        (
            from_tum,
            "0 1 2 3 0 0 0 0\n",
            "line 1: expected a quaternion qx qy qz qw of norm 1, got norm 0; check the columns",
        ),
        (from_tum, "0 1 2 3 0 0 0 1\n0 1 2 3 0 0 60 1\n", "line 2: expected a quaternion .* of norm 1, got norm 60.01"),
        (from_tum, "0 1 2 3 0 0 0 1.02\n", "line 1: expected a quaternion .* of norm 1, got norm 1.02"),
        (from_bop, BOP_LINE.format("1_0", "0 0 0", 1), "line 2: expected scene_id"),
        (from_bop, BOP_LINE.format(1, "0 1_0 0", 1), "line 2: expected scene_id"),
        *((from_tum, f"# t\n0 1 2 3 0 0 0 1\n{line}\n", "line 3: expected finite numbers") for line in INFINITE),
        (from_bop, BOP_LINE.format("nan", "0 0 0", 1), "line 2: expected a finite score and time, got nan and 1"),
        (from_bop, BOP_LINE.format(0.5, "0 0 0", "inf"), "line 2: expected a finite score and time, got 0.5 and inf"),
        (from_bop, BOP_LINE.format(0.5, "0 inf 0", 1), "line 2: expected finite numbers"),
        (from_bop, "a,b\n1,2\n", "expected the columns scene_id"),
        (from_bop, "scene_id,im_id,obj_id,score,R,t,time\n1,1,1,0.5,1 0 0,0 0 0,1\n", "line 2"),
        (
            from_bop,
            "scene_id,im_id,obj_id,score,R,t,time\n1,1,1,0.5,2 0 0 0 1 0 0 0 1,0 0 0,1\n",
            "line 2: .*no rotation",
        ),
    ],
)
def test_broken_files_are_errors(read, text, expected, tmp_path):
    path = tmp_path / "broken.txt"
    with pytest.raises(InputError, match="no such file"):
        read(path)
    path.write_text(text)
    with pytest.raises(InputError, match=expected):
        read(path)

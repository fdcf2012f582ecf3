"""Laws of the contact pose space: its index agrees with exact casts and with poses drawn without it, and its cache is safe."""

import json
import multiprocessing
import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.stats import chi2, kstest
from speed import slow_but

from geomtact.contact_space import space, store
from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.index import Index, pack
from geomtact.contact_space.resolution import choose
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.store import bound_cache, cache_entries, clear_cache, open_index, remove_from_cache
from geomtact.errors import CacheError, MeshError, UsageError
from geomtact.geometry.approach import allowed, approach_of
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.se3 import inverse, log, random_rotations, transform
from geomtact.sensing.sensor import Sensor

MM = 1e-3
TINY = Sensor("tiny", (64, 48), (0.3 * MM, 0.3 * MM), 0.0, 2 * MM)


def weights(index):
    w = np.asarray(index.weight, float).ravel()
    assert w.sum() == pytest.approx(1, abs=1e-6)  # they are kept in single precision
    return w / w.sum()


def some_poses(index, n, rng):
    """Ids (n,) drawn by weight."""
    p = weights(index)
    return rng.choice(len(p), n, p=p / p.sum())


# --- the index against exact casts


def test_stored_masks_equal_exact_casts(localizer, rng):
    index, space = localizer.index, localizer.space
    ids = some_poses(index, 400, rng)
    exact = space.caster.depths(index.sensor, index.poses(ids), index.resolution.mask_shape) > 0
    stored = index.masks(ids)
    both, either = (exact & stored).sum((1, 2)), (exact | stored).sum((1, 2))
    large = exact.sum((1, 2)) > 20
    assert large.sum() > 60
    iou = (both / np.maximum(either, 1))[large]
    assert np.median(iou) > 0.9
    assert np.quantile(iou, 0.1) > 0.6


def test_stored_heights_press_as_deep_as_their_penetration(localizer, rng):
    index, space = localizer.index, localizer.space
    ids = some_poses(index, 400, rng)
    pressed = space.caster.penetration(index.sensor, index.poses(ids))
    off = pressed - np.array(index.resolution.penetrations)[ids // index.places]
    assert abs(np.median(off)) < 0.05 * MM
    assert (np.abs(off) < 0.1 * MM).mean() > 0.8
    assert (np.abs(off) < 0.5 * MM).mean() > 0.95


def test_area_moments_and_packing_are_those_of_the_masks(localizer, rng):
    from geomtact.sensing.moments import moments

    index = localizer.index
    ids = some_poses(index, 200, rng)
    masks = index.masks(ids)
    assert (masks.sum((1, 2)) == index.area.ravel()[ids]).all()
    assert masks.any((1, 2)).all(), "a contact smaller than a pixel still touches somewhere"
    assert np.abs(index.moments[:, ids].T - moments(masks, index.sensor)).max() < 5e-3  # float32, small contacts
    level, place = np.divmod(ids, index.places)
    assert (pack(masks.reshape(len(ids), -1)) == index.bits[level, :, place]).all()


def test_a_mean_mask_pixel_lies_where_the_object_presses(localizer, rng):
    """Frames and signs: the contact's centroid in pixels is the projection of the object's points below the membrane."""
    index, sensor = localizer.index, localizer.sensor
    points = localizer.mesh.surface_points(20_000)
    ids = some_poses(index, 100, rng)
    off = []
    for T, mask in zip(index.poses(ids), index.masks(ids), strict=True):
        p = points @ T[:3, :3].T + T[:3, 3]
        p = p[-p[:, 2] - sensor.sag(p[:, 0], p[:, 1]) > 0]
        xy = sensor.project(p)
        xy = xy[(np.abs(xy) <= sensor.half_window).all(1)]
        if len(xy) < 20 or mask.sum() < 10:
            continue
        x, y = sensor.pixel_centres(mask.shape)
        rows, columns = np.nonzero(mask)
        off.append(np.array([x[columns].mean(), y[rows].mean()]) - xy.mean(0))
    assert len(off) > 20
    assert np.abs(np.median(off, 0)).max() < 0.1 * MM
    assert np.median(np.linalg.norm(off, axis=1)) < 1.5 * MM


def test_each_pose_of_the_index_finds_itself(localizer):
    index = localizer.index
    w = weights(index)
    level = np.arange(len(index)) // index.places
    depth = np.array(index.resolution.penetrations)[level]
    found = index.lookup(index.poses(), depth)
    assert (found == np.arange(len(index)))[w > 0].all()


def test_weights_are_a_distribution_and_the_arrays_small(localizer):
    index = localizer.index
    w = weights(index)
    assert w.sum() == pytest.approx(1, abs=1e-6) and (w >= 0).all()
    assert index.bytes_per_pose <= 500
    n = index.places
    assert index.shift.shape == (n, 2) and index.rotation.shape == (n,)
    assert len(index) == n * len(index.resolution.penetrations)


def test_poses_around_a_place_are_found_as_by_brute_force(localizer, rng):
    index = localizer.index
    every = index.poses()
    for i in some_poses(index, 10, rng):
        rotations = np.unique(np.append(rng.choice(len(index.rotations), 5), index.rotation[i % index.places]))
        point, reach = localizer.mesh.vertices[7], rng.uniform(1e-3, 8e-3)
        where = (every[i] @ np.append(point, 1))[:3]
        ids = index.around(rotations, point, where, reach)
        offset = np.abs(every[:, :3, :3] @ point + every[:, :3, 3] - where).max(1)
        asked = np.isin(index.rotation[np.arange(len(index)) % index.places], rotations)
        clear = np.abs(offset - reach) > 1e-6  # heights are kept in single precision
        assert i in ids and len(np.unique(ids)) == len(ids)
        assert (np.isin(np.arange(len(index)), ids) == (asked & (offset <= reach)))[clear].all()


def test_the_covariance_of_a_cell_is_that_of_draws_from_it(plug, rng):
    """The squared distance of draws from a cell's pose, by its covariance, is 6 in the mean if the cell touches
    everywhere."""
    index = plug.index
    found = []
    for i in rng.choice(len(index), 8, p=weights(index)):
        T = index.poses([i])[0]
        C = index.cell_covariance(T)
        assert np.abs(C - C.T).max() < 1e-12 and (np.linalg.eigvalsh(C) > 0).all()
        drawn, _, ok = draw_within(index, plug.space, np.full(60, i), rng)
        xi = log(inverse(T) @ drawn[ok])
        found.append(np.einsum("ni,ni->n", xi, np.linalg.solve(C, xi.T).T).mean())
    assert 3 < np.median(found) < 15 and max(found) < 60


# --- the index against poses drawn without it


def chi_square(observed, expected, most_off):
    """The p-value of counts, after allowing each expectation to be wrong by the share ``most_off``."""
    few = expected < 8
    observed = np.append(observed[~few], observed[few].sum())
    expected = np.append(expected[~few], expected[few].sum())
    off = np.maximum(np.abs(observed - expected) - most_off * expected, 0)[expected > 0]
    return chi2.sf((off**2 / expected[expected > 0]).sum(), max(1, len(off) - 1))


def test_uniform_poses_fill_the_cells_by_their_weight(localizer, uniform_poses):
    """By depth, by direction, and by half of the window: the shares of the index hold, up to its own coarseness."""
    index = localizer.index
    T, depth = uniform_poses(localizer)
    ids, w = index.lookup(T, depth), weights(index)
    place = np.arange(len(index)) % index.places
    direction = np.repeat(np.arange(len(index.directions.turns)), index.directions.turns)[index.rotation[place]]
    labels = {
        "depth": np.arange(len(index)) // index.places,
        "direction": direction,
        "left or right": (index.shift[place, 0] > 0).astype(int),
        "up or down": (index.shift[place, 1] > 0).astype(int),
    }
    for name, label in labels.items():
        expected = np.bincount(label, w) * len(ids)
        observed = np.bincount(label[ids], minlength=len(expected))
        assert chi_square(observed, expected, 0.05) > 1e-4, name


def test_the_cells_of_a_ball_cover_the_window_and_a_radius_around_it(ball, tmp_path):
    """All cells that lie wholly inside weigh the same: one lattice cell's share of a rounded rectangle."""
    sensor = replace(ball.sensor, housing_depth=None, camera_distance=0.0)
    index = open_index(ball.mesh, sensor, None, 20_000, tmp_path)
    (a, b), R = sensor.half_window, 6 * MM
    area = 4 * a * b + 4 * (a + b) * R + np.pi * R**2
    cells = area / index.resolution.step**2
    share = np.asarray(index.weight, float).sum(0)
    assert share.max() * cells == pytest.approx(1, rel=0.02)
    assert share.sum() == pytest.approx(1)
    assert index.places < 1.1 * cells


@pytest.mark.parametrize("camera_distance", [8 * MM, 20 * MM])
def test_a_camera_sees_a_narrower_window_the_deeper_it_looks(ball, camera_distance, tmp_path):
    """The places at which a ball is touched d deep are those of a window 1 - d/D as wide."""
    sensor = replace(ball.sensor, housing_depth=None, camera_distance=camera_distance)
    index = open_index(ball.mesh, sensor, None, 20_000, tmp_path)
    d = np.array(index.resolution.penetrations)
    a, b = (sensor.half_window[:, None] * (1 - d / camera_distance)).tolist()
    a, b, R = np.array(a), np.array(b), 6 * MM
    area = 4 * a * b + 4 * (a + b) * R + np.pi * R**2
    share = np.asarray(index.weight, float).sum(1)
    assert share == pytest.approx(area / area.sum(), rel=0.01)


def test_uniform_poses_lie_in_the_space_and_press_uniformly(localizer, uniform_poses):
    space = localizer.space
    T, depth = uniform_poses(localizer)
    assert np.abs(space.penetration(T) - depth).max() < 5e-6
    assert allowed(approach_of(T[:, :3, :3]), space.cones).all()
    if space.sensor.housing_depth is None:
        assert kstest(depth, "uniform", args=(0, space.sensor.max_penetration)).pvalue > 1e-4
    else:
        lowest = space.caster.lowest_outside(space.sensor, T)
        assert (lowest >= -space.sensor.housing_depth - 1e-6).all()


def test_no_pose_of_the_index_enters_the_housing(ball, flat_nut, rng):
    for localizer in (ball, flat_nut):
        ids = some_poses(localizer.index, 500, rng)
        lowest = localizer.space.caster.lowest_outside(localizer.sensor, localizer.index.poses(ids))
        clear = lowest >= -localizer.sensor.housing_depth - 0.3 * MM
        assert clear.mean() > 0.97


def test_draws_lie_within_their_cell_and_touch(localizer, rng):
    index, space = localizer.index, localizer.space
    ids = some_poses(index, 60, rng)
    T, depth, found = draw_within(index, space, ids, rng)
    assert found.mean() > 0.7
    assert (index.lookup(T[found], depth[found]) == ids[found]).all()
    assert np.abs(space.penetration(T[found]) - depth[found]).max() < 5e-5  # a mesh's own symmetry is not exact


def test_settle_presses_as_deep_as_asked(localizer, uniform_poses):
    space = localizer.space
    T, _ = uniform_poses(localizer)
    T = T[:60].copy()
    T[:, 2, 3] += 0.5 * MM
    moved, ok = space.settle(T, 0.7 * MM)
    assert ok.mean() > 0.8
    assert np.abs(space.caster.penetration(space.sensor, moved[ok]) - 0.7 * MM).max() < 2e-6
    assert (moved[:, :3, :3] == T[:, :3, :3]).all() and (moved[:, :2, 3] == T[:, :2, 3]).all()


def test_settle_finds_nothing_beside_the_window(ball):
    _, ok = ball.space.settle(transform(np.eye(3), [0.2, 0, 5 * MM]), 1 * MM)
    assert not ok.any()


def test_penetration_is_nan_off_the_space(ball, cone):
    def depth(z, localizer=ball, R=None):
        return localizer.space.penetration(transform(np.eye(3) if R is None else R, [0, 0, z]))[0]

    assert depth(5 * MM) == pytest.approx(1 * MM, abs=2e-5)
    assert np.isnan(depth(6.1 * MM)) and np.isnan(depth(3.9 * MM)) and np.isnan(depth(-20 * MM))
    # a bracket approached from below, where only touches from above are allowed
    R = np.diag([1.0, -1, -1])
    assert approach_of(R)[2] == 1
    T, _ = cone.space.settle(np.stack([transform(R, [0, 0, 30 * MM]), transform(np.eye(3), [0, 0, 30 * MM])]), 0.5 * MM)
    free = ContactSpace(cone.mesh, replace(cone.sensor, housing_depth=None))
    T, ok = free.settle(T, 0.5 * MM)
    assert ok.all() and np.isfinite(free.penetration(T)).all()
    assert np.isnan(cone.space.penetration(T))[1]


def tube(bore: float) -> Mesh:
    made = trimesh.creation.annulus(bore / 2, bore / 2 + 0.01, 0.04, sections=128)
    return Mesh(made.vertices, made.faces, "tube", "m")


@pytest.mark.parametrize("bore, hollow", [(0.09, True), (0.03, False)])
def test_a_bore_wider_than_the_window_is_a_hollow(bore, hollow):
    """Of a tube's surface its inner wall faces itself, all but exactly across the bore."""
    mesh, sensor = tube(bore), Sensor.load("gelslim")
    inner = np.pi * bore * 0.04 / mesh.areas.sum()
    assert ContactSpace(mesh, sensor).hollow == pytest.approx(inner if hollow else 0, abs=0.03)
    assert ContactSpace(mesh, sensor, [((0, 0, 1), 0.1)]).hollow == 0, "what is not approached is no hollow"


def test_a_solid_has_no_hollow(ball):
    assert ContactSpace(ball.mesh, ball.sensor).hollow == 0


def test_a_pose_that_enters_the_housing_does_not_touch():
    """A ball pressed into a window far smaller than itself reaches below the membrane beside it, too."""
    narrow = replace(TINY, pixel_pitch=(0.01 * MM, 0.01 * MM))
    centred = transform(np.eye(3), [0, 0, 5 * MM])
    for housing, touches in ((None, True), (1.01 * MM, True), (0.9 * MM, False), (0.0, False)):
        space = ContactSpace(load_mesh("ball"), replace(narrow, housing_depth=housing))
        assert np.isfinite(space.penetration(centred))[0] == touches


# --- how fine


def test_a_larger_budget_gives_a_finer_grid():
    mesh, sensor = load_mesh("connector_plug").with_symmetry(), Sensor.load("gelslim")
    grids = [choose(mesh, 3e-3, sensor, None, n) for n in (10_000, 100_000, 1_000_000)]
    size = [np.hypot(g.turn_step * mesh.radius_rms, g.step) for g in grids]
    assert size[0] > size[1] > size[2]
    with pytest.raises(UsageError, match="max_poses: expected 1000 to 100,000,000, got 999"):
        choose(mesh, 3e-3, sensor, None, 999)


def test_symmetry_and_approach_buy_finer_lattices(ball, flat_nut, plug):
    assert ball.index.resolution.step < 0.5 * MM
    assert len(ball.index.rotations) == 1
    assert (flat_nut.index.directions.periods == pytest.approx(np.pi / 3)) and len(
        flat_nut.index.directions.vectors
    ) == 1
    assert flat_nut.index.angle_step < 0.3
    assert plug.index.resolution.step > 2 * MM


def test_the_budget_of_poses_is_about_kept(localizer):
    assert 0.4 * 20_000 < len(localizer.index) < 2.2 * 60_000


def test_a_rotation_at_which_nothing_touches_borrows_the_places_of_another(tmp_path):
    """On a grid of so few poses none of the points at which touching is looked for touches, at some rotations."""
    index = open_index(load_mesh("bracket"), Sensor.load("gelslim"), None, 3_000, tmp_path)
    empty = np.setdiff1d(np.arange(len(index.table)), index.rotation)
    assert len(empty) and (index.table[empty] >= 0).all()


# --- the cache


def tiny_index(cache_dir, **options):
    return open_index(load_mesh("ball"), TINY, None, 2000, cache_dir, **options)


def never(*_):
    raise AssertionError("built again")


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Index.ARRAYS)


def test_the_second_opening_loads_the_index_of_the_first(tmp_path, monkeypatch):
    built = tiny_index(tmp_path)
    monkeypatch.setattr(store, "build", never)
    again = tiny_index(tmp_path)
    assert same(built, again) and again.key == built.key and again.resolution == built.resolution
    assert again.deflated.nbytes < again.bits.nbytes / 4
    assert again.mesh.symmetry.kind == "sphere"
    assert not list(tmp_path.glob("building-*"))


def test_every_input_of_an_index_is_in_its_key(tmp_path):
    ball = load_mesh("ball")
    keys = {
        tiny_index(tmp_path).key,
        open_index(ball, TINY, None, 2500, tmp_path).key,
        open_index(ball, replace(TINY, max_penetration=1.5 * MM), None, 2000, tmp_path).key,
        open_index(ball, TINY, [((0, 0, 1), 0.3)], 2000, tmp_path).key,
        open_index(replace(ball, vertices=ball.vertices * 1.1, symmetry=None), TINY, None, 2000, tmp_path).key,
    }
    assert len(keys) == 5
    assert open_index(ball, replace(TINY, note="other words"), None, 2000, tmp_path).key in keys
    assert {e.key for e in cache_entries(tmp_path)} == keys


@pytest.mark.parametrize("name", [f"{a}.npy" for a in Index.ARRAYS] + ["meta.json"])
@pytest.mark.parametrize("harm", slow_but(["truncated", "empty", "gone"], "truncated"))
def test_a_damaged_entry_is_built_anew(tmp_path, name, harm):
    built = tiny_index(tmp_path)
    file = tmp_path / built.key / name
    whole = file.read_bytes()
    file.unlink()
    if harm != "gone":
        file.write_bytes(whole[: len(whole) // 2] if harm == "truncated" else b"")
    again = tiny_index(tmp_path)
    assert same(built, again)
    assert same(built, tiny_index(tmp_path))


def test_an_entry_of_another_version_is_not_read(tmp_path, monkeypatch):
    old = tiny_index(tmp_path)
    monkeypatch.setattr(store, "FORMAT", store.FORMAT + 1)
    assert tiny_index(tmp_path).key != old.key


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path):
    file = tmp_path / "cache"
    file.write_text("not a folder")
    for folder in (file, file / "deeper"):
        with pytest.raises(CacheError, match="cannot be written .*--cache-dir or GEOMTACT_CACHE") as error:
            tiny_index(folder)
        assert "\n" not in str(error.value)


def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store.np, "save", full)
    with pytest.raises(CacheError, match="No space left on device"):
        tiny_index(tmp_path)
    monkeypatch.undo()
    assert [p.suffix for p in tmp_path.iterdir()] in ([], [".lock"])
    assert len(tiny_index(tmp_path))


def test_an_interrupted_build_leaves_no_entry(tmp_path):
    def interrupt(share, _):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tiny_index(tmp_path, progress=interrupt)
    assert not cache_entries(tmp_path) and not list(tmp_path.glob("*/*"))


def _build_slowly(folder, log):
    """Run in a separate process."""
    real = store.build

    def counted(*args, **kwargs):
        with open(log, "a") as file:
            file.write("built\n")
        time.sleep(0.5)
        return real(*args, **kwargs)

    store.build = counted
    index = tiny_index(folder)
    with open(f"{log}.done", "a") as file:
        file.write(f"{len(index)}\n")


@pytest.mark.slow
def test_two_processes_at_once_build_once(tmp_path):
    context = multiprocessing.get_context("spawn")
    log = tmp_path / "log"
    both = [context.Process(target=_build_slowly, args=(tmp_path / "cache", log)) for _ in range(2)]
    for p in both:
        p.start()
    for p in both:
        p.join(60)
    assert [p.exitcode for p in both] == [0, 0]
    assert log.read_text() == "built\n"
    lengths = (tmp_path / "log.done").read_text().split()
    assert len(lengths) == 2 and len(set(lengths)) == 1


def _build_and_wait(folder, flag):
    def stall(*_, **__):
        flag.touch()
        time.sleep(60)

    store.np.save = stall
    tiny_index(folder)


@pytest.mark.slow
def test_a_killed_build_leaves_no_entry_and_no_lock(tmp_path):
    context = multiprocessing.get_context("spawn")
    flag = tmp_path / "writing"
    p = context.Process(target=_build_and_wait, args=(tmp_path / "cache", flag))
    p.start()
    for _ in range(600):
        if flag.exists():
            break
        time.sleep(0.1)
    assert flag.exists()
    clear_cache(tmp_path / "cache")
    assert list((tmp_path / "cache").glob("building-*")), "what a running process builds is left alone"
    p.kill()
    p.join(20)
    assert not cache_entries(tmp_path / "cache")
    assert len(tiny_index(tmp_path / "cache"))
    assert len(cache_entries(tmp_path / "cache")) == 1
    clear_cache(tmp_path / "cache")
    assert not list((tmp_path / "cache").iterdir()), "what the killed build left is cleared too"


def test_the_cache_is_listed_bounded_and_cleared(tmp_path):
    first = tiny_index(tmp_path)
    side = [((0, 0, 2), 0.5)]
    second = open_index(load_mesh("ball"), TINY, side, 3000, tmp_path)
    entries = cache_entries(tmp_path)
    assert {e.key: e.approach for e in entries} == {first.key: None, second.key: [[[0, 0, 1], 0.5]]}
    assert {e.poses for e in entries} == {len(first), len(second)}
    assert all(e.object == "ball" and e.sensor == "tiny" and e.size_bytes > 1000 for e in entries)
    newest = entries[0].key
    (tmp_path / ("0" * 32)).mkdir()
    assert [e.object for e in cache_entries(tmp_path) if not e.poses] == ["damaged"]
    with pytest.raises(UsageError, match="got 'bal'; did you mean 'ball'"):
        remove_from_cache([newest[:6], "bal"], tmp_path)
    assert newest in {e.key for e in cache_entries(tmp_path)}, "nothing is removed where one name fits none"
    assert [e.key for e in remove_from_cache([newest[:12], newest], tmp_path)] == [newest]
    tiny_index(tmp_path)
    open_index(load_mesh("ball"), TINY, side, 3000, tmp_path)
    removed = bound_cache(entries[0].size_bytes, tmp_path)
    assert newest in {e.key for e in cache_entries(tmp_path)} and not {first.key, second.key} <= {
        e.key for e in cache_entries(tmp_path)
    }
    assert removed
    remove_from_cache(["ball"], tmp_path)
    assert not [e for e in cache_entries(tmp_path) if e.object == "ball"]
    clear_cache(tmp_path)
    assert cache_entries(tmp_path) == [] and not list(tmp_path.iterdir())


def test_other_users_may_read_a_cache_and_killed_builds_are_removed(tmp_path):
    key = tiny_index(tmp_path).key
    (like := tmp_path / "made").mkdir()
    assert (tmp_path / key).stat().st_mode == like.stat().st_mode
    clear_cache(tmp_path)
    (left := tmp_path / f"building-{key}-abc").mkdir()
    assert tiny_index(tmp_path).key == key and not left.exists()


def test_progress_goes_from_0_to_1(tmp_path):
    seen = []
    open_index(load_mesh("hex_nut"), TINY, None, 2000, tmp_path, lambda share, what: seen.append((share, what)))
    shares = [s for s, _ in seen]
    assert shares == sorted(shares) and 0 < shares[0] <= 1 and shares[-1] == 1
    assert all(isinstance(what, str) and what for _, what in seen)


def test_the_index_records_its_inputs(tmp_path):
    index = tiny_index(tmp_path)
    meta = json.loads((tmp_path / index.key / "meta.json").read_text())
    assert meta["object_sha256"] == index.mesh.sha256 and meta["poses"] == len(index)


def test_samples_are_the_same_for_the_same_seed(ball):
    one, other = (ball.space.sample(20, np.random.default_rng(5)) for _ in range(2))
    assert (one[0] == other[0]).all() and (one[1] == other[1]).all()


@pytest.mark.parametrize("name", slow_but(["plug", "curved", "plate", "plate on a bulge"], "plug", "plate"))
def test_poses_that_are_not_cast_cannot_touch(name, request, curved_sensor, monkeypatch):
    """The poses drawn are those of casting every one."""
    if name.startswith("plate"):
        solid = trimesh.creation.box((60 * MM, 40 * MM, 2 * MM))
        sensor = curved_sensor if "bulge" in name else Sensor.load("gelsight-mini")
        housed = replace(sensor, housing_depth=3 * MM)
        poses = ContactSpace(Mesh(solid.vertices, solid.faces, "plate", "m"), housed)
    else:
        poses = request.getfixturevalue(name).space
    some, left_out = poses.sample(30, np.random.default_rng(4)), []
    may_touch = ContactSpace._may_touch

    def all_of_them(self, T, depth):
        left_out.append(~may_touch(self, T, depth))
        return np.ones(len(T), bool)

    monkeypatch.setattr(ContactSpace, "_may_touch", all_of_them)
    for one, other in zip(some, poses.sample(30, np.random.default_rng(4)), strict=True):
        assert np.array_equal(one, other)
    assert np.mean(left_out) > 0.1


def test_an_object_much_larger_than_its_sensor_is_sampled_though_it_rarely_touches():
    """One in 400 of the poses within reach, for the housing excludes the others."""
    solid = trimesh.creation.box((600 * MM, 500 * MM, 10 * MM))
    poses = ContactSpace(Mesh(solid.vertices, solid.faces, "plate", "m"), Sensor.load("gelsight-mini"))
    T, depth = poses.sample(64, np.random.default_rng(0))
    assert np.isfinite(poses.penetration(T)).all() and len(T) == len(depth) == 64


def test_where_hardly_any_pose_touches_the_error_counts_the_attempts(ball, monkeypatch):
    for name, few in {"_FIRST": 300, "_MORE": 0}.items():
        monkeypatch.setattr(space, name, few)
    with pytest.raises(
        MeshError, match=r"^ball: expected 5000 poses that touch the sensor 'gelsight-mini' .* found \d+ among"
    ):
        ball.space.sample(5000, np.random.default_rng(0))


def test_rotations_of_samples_are_uniform_over_the_cones(cone, rng):
    """Two overlapping cones: no direction is drawn twice as often for lying in both."""
    a = approach_of(cone.space._rotations(8000, rng))
    assert allowed(a, cone.space.cones).all()
    v = approach_of(random_rotations(60_000, rng))
    v = v[allowed(v, cone.space.cones)]
    for i in range(3):
        edges = np.quantile(v[:, i], np.linspace(0, 1, 11))
        edges[[0, -1]] = -1.1, 1.1
        count = np.histogram(a[:, i], edges)[0]
        assert chi_square(count, np.full(10, 800.0), 0.03) > 1e-4


def test_a_face_leaves_no_tilt(flat_nut):
    """On an exact face the only rotation left is the turn about the sensor's axis."""
    T = flat_nut.index.poses([0])[0]
    rotation = flat_nut.index.cell_covariance(T)[:3, :3]
    turn = flat_nut.index.angle_step**2 / 12
    assert T[:3, :3] @ rotation @ T[:3, :3].T == pytest.approx(np.diag([0, 0, turn]), abs=1e-9)

"""Triplets that others simulated: frames, what counts as touching, and what becomes of a study's figures."""

from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from geomtact import contact_mask, load_mesh
from geomtact.contact_space.space import ContactSpace
from geomtact.errors import NoPoseAgreesError
from geomtact.inference.facts import Diagnostics
from geomtact.se3 import inverse, transform
from geomtact.sensing.image_file import read_image
from geomtact.sensing.sensor import Sensor
from tools.studies.__main__ import app as studies
from tools.studies.triplets import study as triplets
from tools.studies.triplets.study import Outcome, judge, read_triplets, summarise, touching

pytestmark = pytest.mark.studies


@pytest.fixture(scope="module")
def scenes(data_folder):
    return read_triplets(data_folder / "hsp_digit_sim_ycb", seed=1)


@pytest.fixture(scope="module")
def marker(scenes):
    """What :func:`judge` needs of a localizer of the marker, and the marker's triplets."""
    path = next(mesh for mesh in scenes if mesh.stem == "040_large_marker")
    sensor = Sensor.load(triplets.SENSOR)
    space = ContactSpace(load_mesh(path, "m", sensor=sensor), sensor)

    def simulate(T):
        return space.caster.contact(sensor, T)

    return SimpleNamespace(mesh=space.mesh, sensor=sensor, space=space, simulate=simulate), scenes[path]


def knows(T, calls):
    """A ``localize`` that is certain that the object is at ``T``, and keeps its arguments in ``calls``."""

    def localize(images, kind, background, T_world_sensor, **options):
        calls.append((images, kind, background, T_world_sensor))
        return SimpleNamespace(
            modes=lambda k: [SimpleNamespace(T=T, probability=1.0)],
            log_density=lambda pose: 5.0,
            credible_level=lambda pose: 0.25,
            entropy_nats=-4.0,
            diagnostics=Diagnostics(),
        )

    return localize


def outcome(shown="reading", touches=1, **figures):
    usual = {"gain": 1.0, "claimed": 1.0, "level": 0.5, "position_mm": 1.0, "add_s_mm": 1.0, "probability": 0.5}
    return Outcome("a/1", shown, touches, **(usual | {"touching": 3, "warned": False, "ms": 1.0} | figures))


def test_the_world_moves_and_nothing_else(scenes, data_folder):
    assert sum(map(len, scenes.values())) == 20
    again, other = (read_triplets(data_folder / "hsp_digit_sim_ycb", seed) for seed in (1, 2))
    for mesh, some in scenes.items():
        for here, same, there in zip(some, again[mesh], other[mesh], strict=True):
            assert np.array_equal(here.T_world_sensor, same.T_world_sensor)
            assert np.linalg.norm((here.T_world_object - there.T_world_object)[:3, 3]) > 1e-3
            seen, moved = (inverse(t.T_world_sensor) @ t.T_world_object for t in (here, there))
            assert np.abs(seen - moved).max() < 1e-12


def test_a_tactile_image_shows_the_object_where_it_is(marker):
    """The contact found in each picture covers the one cast at its true pose."""
    localizer, some = marker
    for triplet in some[1:2]:
        background = read_image(triplet.background)
        for path, T in zip(triplet.readings, triplet.T_world_sensor, strict=True):
            read = contact_mask(read_image(path), background, localizer.sensor)
            cast = localizer.simulate(inverse(T) @ triplet.T_world_object).mask
            assert (read & cast).sum() / (read | cast).sum() > 0.65, path


def test_the_true_pose_touches_all_three_and_one_moved_off_does_not(marker):
    localizer, some = marker
    for triplet in some:
        T, pose = triplet.T_world_sensor, triplet.T_world_object
        assert touching(localizer, T, pose).all()
        for k in range(3):
            for mm in (-6, 6):  # along the sensor's z, off it and into it
                moved = T[k] @ transform(np.eye(3), [0, 0, 1e-3 * mm]) @ inverse(T[k]) @ pose
                assert not touching(localizer, T, moved)[k]


def test_a_posterior_at_the_true_pose_is_right(marker, monkeypatch):
    localizer, some = marker
    monkeypatch.setattr(triplets, "POINTS", 1000)
    calls = []
    localizer.localize = knows(some[0].T_world_object, calls)
    (outcomes,) = judge(localizer, some[:1], "balanced", 1)
    both = [(shown, n) for shown in ("reading", "ideal") for n in (1, 2, 3)]
    assert [(o.shown, o.touches) for o in outcomes] == [("chance", 0), *both]
    for o in outcomes[1:]:
        assert o.position_mm == 0 and o.add_s_mm < 1e-9 and o.touching == 3
        assert (o.gain, o.claimed, o.level) == (5.0, 4.0, 0.25)
    assert outcomes[0].position_mm > 5 and outcomes[0].touching >= 1
    for (images, kind, background, T), (shown, n) in zip(calls, both, strict=True):
        assert len(images) == len(T) == n
        assert (kind, background is None) == (("mask", True) if shown == "ideal" else ("reading", False))


def test_no_pose_that_agrees_is_infinitely_wrong(marker):
    localizer, some = marker

    def contradicted(*args, **options):
        raise NoPoseAgreesError("no pose agrees")

    localizer.localize = contradicted
    (outcomes,) = judge(localizer, some[:1], "balanced", 1)
    for o in outcomes[1:]:
        assert o.position_mm == np.inf and o.gain == -np.inf and o.level == 1 and o.touching == 0 and o.warned


def test_figures_are_of_each_kind_and_number():
    some = [outcome(position_mm=x, touching=k) for x, k in ((1.0, 3), (2.0, 3), (9.0, 0))]
    some += [outcome(touches=2, gain=-np.inf, position_mm=np.inf), outcome(touches=2, gain=3.0)]
    one, two = summarise(some)
    assert (one["touches"], one["n"], two["touches"], two["n"]) == (1, 3, 2, 2)
    assert one["position_mm_mean"] == 4 and one["position_mm_quartiles"][1] == 2
    assert one["compatible"] == one["touched"] == pytest.approx(2 / 3)
    assert two["gain_mean"] == 3 and two["ruled_out"] == 0.5


@pytest.mark.parametrize(
    ("words", "status", "expected"),
    [
        ([], 2, "Missing argument 'FOLDER'"),
        (["a", "b"], 2, "unexpected extra argument"),
        (["nowhere"], 3, "hsp_digit_sim_ycb"),
    ],
)
def test_without_the_data_the_error_names_the_folder(words, status, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(studies, ["triplets", *words])
    assert done.exit_code == status, done.output
    assert expected in done.output

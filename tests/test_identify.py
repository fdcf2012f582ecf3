"""Object identification: probabilities of objects by their evidence."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from speed import slow_but
from typer.testing import CliRunner

from geomtact import GaussianPrior, InputError, Mesh, Sensor, UsageError
from geomtact.cli import app
from geomtact.cli.several import objects_of
from geomtact.errors import NoPoseAgreesError
from geomtact.evaluation import simultaneous_touches
from geomtact.identification import _MISFIT_NATS, _MISSED, identify
from geomtact.inference.effort import GRID_ALONE
from geomtact.inference.facts import Diagnostics
from geomtact.sensing.image_file import write_image
from geomtact.sensing.noise import MODERATE
from tools.studies.common.pictures import draw
from tools.studies.identify.study import Told, identify_scenes, summarise


@pytest.fixture(scope="module")
def drawer(make_localizer):
    """Three objects of different contacts."""

    def prepared(name, shape):
        mesh = Mesh(shape.vertices, shape.faces, name, "m")
        return make_localizer(mesh, "gelslim", max_poses=4000, touches=120, scorer="moments")

    return [
        prepared("rod", trimesh.creation.box((60e-3, 3e-3, 3e-3))),
        prepared("ball", trimesh.creation.icosphere(3, 12e-3)),
        prepared("block", trimesh.creation.box((30e-3, 30e-3, 30e-3))),
    ]


def touches(localizer, n=1, seed=0):
    """The contacts at poses drawn from the contact pose space."""
    T = localizer.space.sample(n, np.random.default_rng(seed), (3e-4, 1.5e-3))[0]
    return [localizer.simulate(each).mask for each in T]


@pytest.mark.parametrize(("n", "errors"), [(40, 2), pytest.param(160, 3, marks=pytest.mark.slow)])
def test_touches_are_identified_among_those_of_other_objects(drawer, n, errors):
    """The mean evidence of the true object is largest (a Kullback-Leibler divergence is not negative). That of a
    ball's touches is by far; the corners of a rod and of a block are alike. Few touches are outliers of their own object.

    Evidences that are fitted on 120 touches differ by 0.3 nats from fit to fit (four fits): the bound leaves twice that."""
    unlike = []
    for own in drawer:
        found = [
            {c.name: c for c in identify(drawer, mask, kind="mask", effort=GRID_ALONE).candidates}
            for mask in touches(own, n)
        ]
        unlike += [each[own.mesh.name].is_outlier for each in found]
        for other in drawer:
            gain = [each[own.mesh.name].log_evidence - each[other.mesh.name].log_evidence for each in found]
            assert np.mean(gain) >= -0.6 - 3 * np.std(gain) / np.sqrt(len(gain))
            if own is not other and own.mesh.name == "ball":
                assert np.mean(gain) > errors * np.std(gain) / np.sqrt(len(gain))
    assert np.mean(unlike) < 0.05


def test_the_most_probable_comes_first_with_its_posterior(drawer):
    for own in drawer:
        found = identify(drawer, touches(own)[0], kind="mask", effort=GRID_ALONE)
        probabilities = [c.probability for c in found.candidates]
        assert sum(probabilities) == pytest.approx(1) and probabilities == sorted(probabilities)[::-1]
        assert found.posterior.mesh is found.localizer.mesh and found.localizer.mesh.name == found.candidates[0].name


def test_probabilities_are_evidence_times_weights(drawer):
    """The evidence of one contact's moments counts by a quarter, before the weights do."""
    mask = touches(drawer[1])[0]
    alike = {c.name: c for c in identify(drawer, mask, kind="mask", effort=GRID_ALONE).candidates}
    for name, candidate in alike.items():
        own = next(each for each in drawer if each.mesh.name == name)
        assert candidate.log_evidence == own.localize(mask, "mask", effort=GRID_ALONE).log_evidence
    beyond = alike["ball"].log_evidence - alike["rod"].log_evidence
    assert alike["ball"].probability / alike["rod"].probability == pytest.approx(np.exp(beyond / 4))
    weights = (1.0, 2.0, 0.0)
    found = {
        c.name: c.probability for c in identify(iter(drawer), mask, weights, kind="mask", effort=GRID_ALONE).candidates
    }
    assert found["block"] == 0
    expected = 2 * alike["ball"].probability / alike["rod"].probability
    assert found["ball"] / found["rod"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("said", "unlike"),
    [
        ({"is_outlier": False}, False),
        ({"is_outlier": True}, True),
        ({"is_outlier": False, "misfit_nats": np.inf}, True),
        ({"is_outlier": False, "unexplained_nats": 8.1, "misfit_nats": 0.9 * _MISFIT_NATS}, False),
        ({"is_outlier": False, "unexplained_nats": 0.0, "misfit_nats": 1.1 * _MISFIT_NATS}, True),
    ],
)
def test_unlike_all_are_outliers_or_unexplained_touches_of_each_object(drawer, said, unlike):
    def localizer(said):
        posterior = SimpleNamespace(contact=True, log_evidence=0.0, diagnostics=Diagnostics(**said))
        return SimpleNamespace(
            mesh=drawer[0].mesh, sensors=[drawer[0].sensor], localize=lambda image, effort=None: posterior
        )

    image = np.zeros(drawer[0].sensor.image_size_px[::-1], bool)

    assert identify([localizer(said)], image).is_unknown == unlike
    assert not identify([localizer(said), localizer({"is_outlier": False})], image).is_unknown, (
        "one that it is like is enough"
    )


@pytest.mark.slow
def test_contacts_tell_objects_apart_that_moments_do_not(drawer):
    """By contacts the right one of three objects is the most probable in more of the same touches, and given more: the log of its
    probability is larger in the mean. None that explains them is ruled out."""
    efforts = {"moments": GRID_ALONE, "contacts": "fast"}
    right, logs = dict.fromkeys(efforts, 0), {name: [] for name in efforts}
    for own in drawer:
        for mask in touches(own, 6, seed=3):
            for by, effort in efforts.items():
                found = identify(drawer, mask, kind="mask", effort=effort)
                given = {each.name: each.probability for each in found.candidates}
                right[by] += found.candidates[0].name == own.mesh.name
                logs[by].append(np.log(given[own.mesh.name]))
            assert min(given.values()) >= _MISSED / 3 - 1e-12 and sum(given.values()) == pytest.approx(1)
    assert right["contacts"] > right["moments"] and np.mean(logs["contacts"]) > np.mean(logs["moments"])


def test_the_evidence_of_contacts_does_not_depend_on_the_cells(drawer, make_localizer):
    """Of one object on 4,000 poses and on four times as many."""
    finer = make_localizer(drawer[2].mesh, "gelslim", max_poses=16_000, touches=120, scorer="moments")
    masks = touches(drawer[2], 8, seed=5)
    apart = [
        finer.localize(mask, "mask", seed=1).log_evidence - drawer[2].localize(mask, "mask", seed=1).log_evidence
        for mask in masks
    ]
    assert abs(np.mean(apart)) < 0.2 + 3 * np.std(apart) / np.sqrt(len(apart)), "each is found to about a nat"


def test_a_prior_that_says_nothing_leaves_the_evidence(drawer):
    """A Gaussian far wider than the contact pose space; its evidence is a mean over the prior, which is then uniform."""
    T = drawer[2].space.sample(1, np.random.default_rng(2))[0][0]
    wide = GaussianPrior(T, np.diag([3.0**2] * 3 + [0.3**2] * 3))
    apart = []
    for mask in touches(drawer[2], 5, seed=6):
        with_prior, alone = (drawer[2].localize(mask, "mask", prior=prior).log_evidence for prior in (wide, None))
        apart.append(with_prior - alone)
    assert abs(np.mean(apart)) < 0.5 + 2 * np.std(apart) / np.sqrt(len(apart))


def test_the_posterior_is_that_of_the_most_probable():
    """Whatever the weights, also where no object has a pose that was found; an object without weight is never it."""

    def localizer(name, evidence):
        posterior = SimpleNamespace(
            contact=True, log_evidence=evidence, diagnostics=Diagnostics(evidence_of="contacts", misfit_nats=0.0)
        )
        mesh = SimpleNamespace(name=name)
        return SimpleNamespace(mesh=mesh, sensors=[Sensor.load("gelslim")], localize=lambda image, effort: posterior)

    image = np.zeros((320, 427), bool)
    for evidences, weights, best in (
        ((0.0, 4.4), (0.9, 0.1), "b"),
        ((0.0, 4.3), (0.9, 0.1), "a"),
        ((-np.inf, -np.inf), (0.3, 0.7), "b"),
        ((0.0, -np.inf), (0.1, 0.9), "a"),
    ):
        both = [localizer(name, evidence) for name, evidence in zip("ab", evidences, strict=True)]
        found = identify(both, image, weights, effort="balanced")
        assert found.candidates[0].name == found.localizer.mesh.name == best
        assert sum(each.probability for each in found.candidates) == pytest.approx(1)

    def refuses(image, effort):
        raise NoPoseAgreesError("none")

    refusing = localizer("c", 0.0)
    refusing.localize = refuses
    with pytest.raises(UsageError, match="no object with a weight"):
        identify([localizer("b", 9.0), refusing], image, (0.0, 1.0))


@pytest.mark.parametrize("scenes", slow_but((1, 2), 1))
@pytest.mark.parametrize("flat", slow_but((0, 2), 2))
def test_three_noisy_touches_of_an_object_are_not_unlike_it(drawer, flat, scenes):
    """Rigid and elastic gels in turn; some scenes of each object that has flats."""
    for scene in simultaneous_touches(drawer[flat].space, scenes, 3, 1):
        masks = [touch.mask for touch in scene.touches]
        assert not identify([drawer[flat]], masks, kind="mask", T_world_sensor=scene.T_world_sensor, seed=1).is_unknown


def test_no_contact_does_not_change_the_probabilities(drawer):
    found = identify(drawer, np.zeros((320, 427), bool), kind="mask", effort=GRID_ALONE)
    assert not found.posterior.contact and not found.is_unknown
    assert [c.probability for c in found.candidates] == pytest.approx([1 / 3] * 3)


def test_an_object_without_a_possible_pose_has_no_probability(drawer, monkeypatch):
    mask = touches(drawer[1])[0]

    def refuses(self, *args, **kwargs):
        raise NoPoseAgreesError("none")

    class Refusing:
        mesh = drawer[0].mesh
        sensors = drawer[0].sensors
        localize = refuses

    found = identify([Refusing(), drawer[1]], mask, kind="mask", effort=GRID_ALONE)
    assert found.localizer is drawer[1] and found.candidates[1].probability == 0 and found.candidates[1].is_outlier
    with pytest.raises(NoPoseAgreesError):
        identify([Refusing()], mask)


@pytest.mark.parametrize("weights", [(1.0,), (1.0, 1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (0.0, 0.0, 0.0), (np.nan, 1, 1)])
def test_weights_that_do_not_fit_are_refused(drawer, weights):
    with pytest.raises(UsageError, match="identify: expected"):
        identify(drawer, touches(drawer[0])[0], weights, kind="mask", effort=GRID_ALONE)
    with pytest.raises(UsageError, match="identify: expected a localizer for each object, got int"):
        identify(3, None)
    with pytest.raises(UsageError, match="expected objects"):
        identify([], None)


def test_objects_are_given_by_a_folder_or_by_names(tmp_path):
    assert objects_of(None) == [None] and objects_of("pin") == ["pin"] and objects_of("pin, head") == ["pin", "head"]
    meshes = Path(__file__).parents[1] / "meshes"
    assert "pin" in objects_of(str(meshes)) and len(objects_of(str(meshes))) == 10
    with pytest.raises(InputError, match="no mesh in this folder"):
        objects_of(str(tmp_path))
    with pytest.raises(InputError, match="each object once"):
        objects_of("pin,pin")
    for name in ("b.stl", "a.ply", "note.txt"):
        (tmp_path / name).touch()
    (tmp_path / "._a.ply").write_bytes(b"\0\5\x16\7")  # beside each file on disks that macOS writes to
    assert objects_of(str(tmp_path)) == [str(tmp_path / "a.ply"), str(tmp_path / "b.stl")]
    odd = tmp_path / "a,b.stl"
    odd.touch()
    assert objects_of(str(odd)) == [str(odd)], "a file's name may hold a comma"


@pytest.mark.slow
def test_the_command_line_identifies_the_object(drawer, few_touches, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "parts").mkdir()
    for localizer in drawer[:2]:
        mesh = localizer.mesh
        trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces).export(tmp_path / "parts" / f"{mesh.name}.stl")
    write_image(tmp_path / "touch.png", touches(drawer[1], seed=2)[0])
    run = ["localize", "touch.png", "--object", "parts", "--unit", "mm", "--sensor", "gelslim"]
    run += ["--max-poses", "1500", "--scorer", "moments", "--effort", "fast", "--cache-dir", "c"]
    done = CliRunner().invoke(app, [*run, "--out", "out"])
    assert done.exit_code == 0, done.output
    said = json.loads((tmp_path / "out" / "result.json").read_text())
    assert said["object"]["name"] == "ball" and [each["name"] for each in said["candidates"]] == ["ball", "rod"]
    assert "log evidence" in done.stdout
    refused = CliRunner().invoke(app, [*run, "--prior", "out/posterior.npz"])
    assert refused.exit_code == 2 and "several objects exclude" in " ".join(refused.output.split())


@pytest.mark.studies
def test_the_study_reports_the_figures_of_identify(drawer):
    scenes = list(identify_scenes(drawer[1], drawer, 2, 3, MODERATE, "fast", first=1))
    assert [[each.touches for each in some] for some in scenes] == [[1, 2, 3]]
    assert all(each.scene == 1 and set(each.log_probability) == {"rod", "ball", "block"} for each in scenes[0])
    last = scenes[0][-1].log_probability  # one touch may suit either; after three the ball is 1.9 nats ahead
    assert last["ball"] > max(last["rod"], last["block"])


@pytest.mark.studies
def test_figures_of_the_study_follow_from_its_records():
    def record(touches, a, b, unlike_a, unlike_b):
        logs = np.array([a, b]) - np.logaddexp(a, b)
        return Told(0, touches, dict(zip("ab", logs.tolist(), strict=True)), {"a": unlike_a, "b": unlike_b})

    of_a = [record(1, 0.0, -9.0, False, True), record(2, 0.0, -9.0, True, True), record(3, 0.0, 0.0, True, True)]
    of_b = [record(1, 5.0, 0.0, False, False), record(2, 0.0, 0.1, True, False), record(3, -9.0, 0.0, True, False)]
    one, two, three = summarise({"a": of_a, "b": of_b})
    assert (one["right"][0], one["foreign"][0], one["alarmed"][0], one["sure_and_wrong"]) == (0.5, 0.5, 0, 0.5)
    assert (two["right"][0], two["foreign"][0], two["alarmed"][0], two["sure_and_wrong"]) == (1, 1, 0.5, 0)
    assert (three["foreign"][0], three["alarmed"][0]) == (1, 0.5)
    assert three["right"][1] < three["right"][0] <= three["right"][2] and three["n"] == 2
    content = {"schema": "geomtact/identification/1", "figures": [one, two, three]}
    content["parts"] = {
        name: {
            "outcomes": [
                [
                    {"log_probability": {k: e if np.isfinite(e) else None for k, e in t.log_probability.items()}}
                    for t in some
                ]
            ]
        }
        for name, some in (("a", of_a), ("b", of_b))
    }
    assert draw(content).startswith(b"\x89PNG")

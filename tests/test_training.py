"""Laws of training: objects are solid, touches belong to the cells they name, noise stays in its range, runs repeat."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from geomtact.contact_space.touch import LEAST_CONTACT
from geomtact.errors import GeomtactError, InputError
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.effort import GRID_ALONE
from geomtact.scoring import precision
from geomtact.scoring.catalogue import descriptor_of
from geomtact.scoring.contact_features import BASIS, SHAPE, moment_features
from geomtact.scoring.encoder import WEIGHTS, Tower, load_weights, vector
from geomtact.scoring.network import Encoder, run
from geomtact.sensing.moments import moments
from geomtact.sensing.sensor import Sensor
from geomtact.training import scenes as scenes_module
from geomtact.training.augment import AUGMENTATIONS, augmented
from geomtact.training.card import write_encoder
from geomtact.training.dataset import object_scenes
from geomtact.training.scenes import KEY_SHAPE, TOUCH_SHAPE, make_scene
from geomtact.training.state import claim, resume, save_state
from geomtact.training.train import Settings, scene_gain, train
from tools.training.procedural import random_object

TINY = Settings(steps=6, scenes_a_step=2, touches=20, stored=200, width=32, dimension=8, validation=1)


CELL = np.array([-0.7, -1.1], np.float32)


def unpacked(words, shape):
    return np.unpackbits(words.view(np.uint8), axis=1).reshape(-1, *shape).astype(bool)


@pytest.fixture(scope="module")
def scenes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes_module, "DIRECTIONS", 6)
        return [
            make_scene(load_mesh(name), Sensor.load(sensor), 60_000, np.random.default_rng(1))
            for name, sensor in (("bracket", "gelslim"), ("gear", "digit"), ("connector_plug", "gelslim"))
        ]


@pytest.fixture(scope="module")
def weights():
    torch.manual_seed(3)
    return {name: value.numpy() for name, value in Encoder(48, 8).state_dict().items()}


def test_a_procedural_object_is_a_solid_of_its_size_and_repeats():
    for seed in range(12):
        made = random_object(seed, 0.05)
        assert load_mesh(made).sha256 == made.sha256, "it passes all checks that a user's mesh has to pass"
        assert (random_object(seed, 0.05).vertices == made.vertices).all()
        size = made.vertices.max(0) - made.vertices.min(0)
        assert np.linalg.norm(size) >= 0.05 * 0.999 and made.diameter <= 0.05 * np.sqrt(3)


def test_a_touch_lies_near_the_stored_contact_of_its_cell(scenes):
    for scene in scenes:
        assert scene.weight.sum() == pytest.approx(1, abs=1e-5)
        assert (scene.weight[scene.true] > 0).all()
        stored, touches = unpacked(scene.stored, KEY_SHAPE), unpacked(scene.touches, TOUCH_SHAPE)
        sensor = Sensor("any", (64, 48), (1e-3, 1e-3), 0.0, 2e-3)
        far = np.linalg.norm(moments(touches, sensor)[:, None, :2] - moments(stored, sensor)[None, :, :2], axis=-1)
        own = far[np.arange(len(far)), scene.true]
        assert np.median(own) < 0.5 * np.median(far)


def test_an_elastic_contact_lies_within_the_rigid_one(scenes):
    for scene in scenes:
        touches, soft = unpacked(scene.touches, TOUCH_SHAPE), np.flatnonzero(scene.elastic)
        rigid, elastic = touches[soft - 1], touches[soft]
        assert len(soft) and not scene.elastic[soft - 1].any() and (scene.true[soft - 1] == scene.true[soft]).all()
        assert not (elastic & ~rigid).any() and elastic.sum() < 0.95 * rigid.sum()


def test_a_touch_has_the_least_area_on_either_gel(scenes):
    for scene in scenes:
        area = unpacked(scene.touches, TOUCH_SHAPE).sum((1, 2)) * scene.pixel**2
        assert area.min() >= LEAST_CONTACT
        assert (~scene.elastic).sum() > scene.elastic.sum(), "what a rigid gel feels faintly, an elastic one does not"


def test_noise_keeps_masks_masks_and_repeats():
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    masks = ((((x - 30) / 33) ** 2 + ((y - 20) / 22) ** 2) < 1).float().expand(40, 1, 48, 64)
    pixel = 0.7e-3
    for augmentation in AUGMENTATIONS:
        out, again = (augmentation.apply(masks, pixel, torch.Generator().manual_seed(1)) for _ in range(2))
        assert torch.equal(out, again) and ((out == 0) | (out == 1)).all()
        changed = (out != masks).flatten(1).float().mean(1)
        assert changed.max() > 0, augmentation.name
        assert changed.max() < 0.25, augmentation.name
    whole = augmented(masks, pixel, torch.Generator().manual_seed(2))
    assert (whole.sum((1, 2, 3)) > 0).all()
    moved = moments(whole[:, 0].numpy() > 0.5, Sensor("any", (64, 48), (pixel, pixel), 0.0, 2e-3))
    assert moved.std(0)[:2].max() < 0.1, "noise does not carry a contact across the window"


def test_a_touch_needs_no_torch_and_gets_the_same_vector(weights, rng):
    images = rng.random((5, *SHAPE)).astype(np.float32) > 0.7
    images[1] = 0
    by_torch = Encoder(48, 8)
    by_torch.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    with torch.no_grad():
        expected = by_torch(torch.from_numpy(images.astype(np.float32)), torch.from_numpy(CELL), "touch").numpy()
    got = np.stack([vector(weights, image.astype(np.float32), CELL) for image in images])
    assert got == pytest.approx(expected, abs=1e-4)


def test_both_precisions_describe_contacts_alike(rng, monkeypatch):
    """By the weights that ship: then the posteriors of the pin's touches differ by 0.005 nats each, 0.0005 in the mean."""
    weights = load_weights(WEIGHTS)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    middle, radius = rng.uniform(0, SHAPE, (200, 2)), rng.uniform(1, 12, 200)
    disks = np.hypot(y - middle[:, :1, None], x - middle[:, 1:, None]) < radius[:, None, None]
    vectors = {}
    for dtype in (torch.float32, torch.bfloat16):
        monkeypatch.setattr(precision, "fastest_precision", lambda dtype=dtype: dtype)
        vectors[dtype] = run(weights, disks.astype(np.float32), CELL, "stored")
    off = vectors[torch.bfloat16] - vectors[torch.float32]
    assert 0 < np.sqrt((off**2).mean()) < 1e-3 and np.abs(off).max() < 1e-2


def test_no_processor_computes_in_bfloat16_that_only_emulates_it():
    """What torch may use is limited to AVX2, which has no bfloat16."""
    limits = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2"}
    code = "from geomtact.scoring.precision import fastest_precision; print(fastest_precision())"
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, env=os.environ | limits, capture_output=True, text=True, check=True).stdout
    assert said.strip() == "torch.float32"


def test_its_moments_are_those_of_sensing(rng):
    masks = np.zeros((4, *SHAPE), bool)
    masks[0, 3:9, 4:20], masks[1, 10:20, 25:28], masks[2, :, :], masks[3, 5, 5] = True, True, True, True
    sensor = Sensor("any", (64, 48), (1e-3, 1e-3), 0.0, 2e-3)
    got = moment_features(masks.reshape(4, -1).astype(np.float32) @ BASIS, np)
    expected = moments(masks, sensor).astype(float)
    expected[:, :2] *= 3
    expected[:, 2] = expected[:, 2] / 2 + 2
    expected[:, 3] += 1.2
    assert got == pytest.approx(expected, abs=2e-3)


def test_a_tall_window_is_seen_lying(weights):
    masks = np.zeros((3, 24, 32), bool)
    masks[:, 2:9, 5:20] = True
    tower = Tower(weights, CELL)
    sensor = Sensor.load("gelslim")
    lying = tower.describe(masks, sensor)
    assert tower.describe(np.swapaxes(masks, 1, 2), sensor) == pytest.approx(lying)
    assert tower.describe(np.kron(masks, np.ones((1, 2, 2), bool)), sensor) == pytest.approx(lying, abs=1e-6)
    assert run(weights, masks.astype(np.float32), CELL, "stored") == pytest.approx(lying, abs=1e-6)


def test_training_learns_and_a_resumed_run_ends_where_a_whole_one_does(scenes, tmp_path):
    network, curve = train(scenes, TINY, tmp_path / "whole", check_every=3)
    calls = []

    def stop(share, _):
        calls.append(share)
        if len(calls) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scenes, TINY, tmp_path / "resumed", stop, check_every=3)
    resumed, again = train(scenes, TINY, tmp_path / "resumed", check_every=3)
    assert again == curve and curve.step == [3, 6]
    for name, value in network.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name


def test_the_gain_of_a_network_equals_that_of_its_posterior(scenes):
    """The loss is minus the log density at the truth: 0 for a network that distinguishes nothing."""
    network = Encoder(16, 4)
    with torch.no_grad():
        for head in network.heads.values():
            head[2].weight.zero_()
            head[2].bias.zero_()
        gain = scene_gain(network, scenes[0], TINY, np.random.default_rng(0))
    assert gain.numpy() == pytest.approx(0, abs=1e-4)


def test_nan_stops_training_and_names_what_is_kept(scenes, tmp_path, monkeypatch):
    train(scenes, TINY, tmp_path, check_every=3)
    before = (tmp_path / "state.safetensors").read_bytes()
    longer = Settings(**{**TINY.__dict__, "seed": 5})
    monkeypatch.setattr(
        "geomtact.training.train.scene_gain", lambda n, *_, **__: n.heads["touch"][2].bias.sum() * torch.nan
    )
    with pytest.raises(GeomtactError, match="not a number at step 0; the state of step 6 is kept"):
        train(scenes, longer, tmp_path)
    assert (tmp_path / "state.safetensors").read_bytes() == before
    with pytest.raises(InputError, match="expected more than 1 scenes, got 1"):
        train(scenes[:1], TINY, tmp_path)


def test_a_gradient_that_is_no_number_stops_training_before_it_is_taken(scenes, tmp_path, monkeypatch):
    """Also where another scene of the same step has a loss that is one."""
    calls = []

    def some_gain(network, *_, **__):
        calls.append(1)
        return network.heads["touch"][2].bias.sum() * (torch.nan if len(calls) == 3 else 1.0)

    monkeypatch.setattr("geomtact.training.train.scene_gain", some_gain)
    with pytest.raises(
        GeomtactError, match="not a number at step 1; no state is kept yet; go on with a smaller --rate"
    ):
        train(scenes, TINY, tmp_path)


def test_a_folder_of_another_training_is_refused(tmp_path):
    claim(tmp_path, {"part": "a", "seed": 0})
    claim(tmp_path, {"part": "a", "seed": 0})
    with pytest.raises(InputError, match="holds another training .part differs.; give another folder with --work"):
        claim(tmp_path, {"part": "b", "seed": 0})


def test_a_resumed_run_may_have_another_rate_and_nothing_else(tmp_path):
    network = torch.nn.Linear(2, 1)
    optimizer = torch.optim.SGD(network.parameters(), 0.1, momentum=0.5)
    network(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    save_state(tmp_path, network, optimizer, {"rate": 0.1, "seed": 1}, 7, {"loss": [0.5]})
    other = torch.nn.Linear(2, 1)
    fresh = torch.optim.SGD(other.parameters(), 0.1, momentum=0.5)
    assert resume(tmp_path, other, fresh, {"rate": 0.1, "seed": 2}) == (0, None)
    assert resume(tmp_path, other, fresh, {"rate": 0.05, "seed": 1}) == (7, {"loss": [0.5]})
    assert torch.equal(other.weight, network.weight)
    assert torch.equal(fresh.state[other.weight]["momentum_buffer"], optimizer.state[network.weight]["momentum_buffer"])


def test_weights_for_one_object_are_refused_for_another(weights, tmp_path, ball):
    own = {"part": "ball", "part_sha256": ball.mesh.sha256, "sensor": "digit", "sensor_sha256": "0"}
    path = tmp_path / "mine.safetensors"
    save_file(weights, path, own | {"sensor_sha256": ball.sensor.sha256})
    assert descriptor_of(str(path), ball.index) is not None
    save_file(weights, path, own)
    with pytest.raises(InputError, match="trained for the sensor 'digit', not for 'gelsight-mini'"):
        descriptor_of(str(path), ball.index)
    save_file(weights, path, {"part": "gear", "part_sha256": "1"})
    with pytest.raises(InputError, match="trained for the part 'gear', not for 'ball'; train weights for it, or use"):
        descriptor_of(str(path), ball.index)


def test_scenes_are_made_once_and_repeat(tmp_path):
    mesh, sensor = load_mesh("hex_nut"), Sensor.load("gelsight-mini")
    first = object_scenes(tmp_path, mesh, sensor, 5_000, 2, seed=4, processes=1)
    times = {p: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    second = object_scenes(tmp_path, mesh, sensor, 5_000, 2, seed=4, processes=1)
    assert {p: p.stat().st_mtime_ns for p in tmp_path.iterdir()} == times and len(times) == 2
    for a, b in zip(first, second, strict=True):
        assert (a.stored == b.stored).all() and (a.true == b.true).all()


def test_weights_are_written_read_and_refused(scenes, tmp_path):
    network, curve = train(scenes, TINY, tmp_path / "work", check_every=6)
    path = tmp_path / "e.safetensors"
    write_encoder(path, network, curve, TINY, scenes, {"parts": "three"})
    assert {p.suffix for p in tmp_path.glob("e.*")} == {".safetensors", ".json", ".png"}
    weights = load_weights(path)
    assert weights["trunk.0.weight"].shape == (32, 776) and weights["trunk.0.weight"].dtype == np.float32
    for content, message in (
        (b"", "not a whole safetensors file"),
        (path.read_bytes()[:-9], "not a whole safetensors"),
    ):
        (tmp_path / "broken.safetensors").write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_weights(tmp_path / "broken.safetensors")
    other = load_file(path)
    other["trunk.2.weight"] = other["trunk.2.weight"][:, :5]
    save_file(other, tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="the weights of another network"):
        load_weights(tmp_path / "other.safetensors")
    half = {name: value for name, value in load_file(path).items() if "stored" not in name}
    save_file(half, tmp_path / "half.safetensors")
    with pytest.raises(InputError, match="the weights of another network"):
        load_weights(tmp_path / "half.safetensors")
    with pytest.raises(InputError, match="no such file"):
        load_weights(tmp_path / "none.safetensors")


def test_a_localizer_takes_the_path_of_weights(make_localizer, weights, tmp_path):
    save_file(weights, tmp_path / "mine.safetensors")
    path = str(tmp_path / "mine.safetensors")
    localizer = make_localizer("ball", "gelsight-mini", max_poses=4000, touches=60, scorer=path)
    assert localizer.scorer.scorer.stored.shape == (len(localizer.index), 8)
    mask = np.zeros((240, 320), bool)
    mask[100:140, 150:190] = True
    posterior = localizer.localize(mask, kind="mask", effort=GRID_ALONE)
    assert np.exp(posterior.log_prob).sum() == pytest.approx(1, abs=1e-5)
    assert posterior.provenance.scorer == path


def test_a_contact_far_from_all_stored_ones_counts_for_less():
    """Its best score becomes the worst that is usual, and all others shrink alike; a usual contact is left alone."""
    from types import SimpleNamespace

    from geomtact.scoring.encoder import EncoderScorer

    stored = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)

    class At(EncoderScorer):
        def seen(self, index, mask):
            return np.full(4, mask, np.float32)

    index = SimpleNamespace(height=np.zeros((2, 25)))
    plain, limited = At(None, stored), At(None, stored, usual=6.0)
    assert limited.score(index, 0.1) == pytest.approx(plain.score(index, 0.1))
    far, full = limited.score(index, 9.0), plain.score(index, 9.0)
    assert far.max() == pytest.approx(-6, rel=1e-4)
    assert far / full == pytest.approx(np.full((2, 25), 6 / -full.max()), rel=1e-4)

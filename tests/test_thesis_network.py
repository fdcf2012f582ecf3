"""Laws of the thesis's own network: its loss, its pairs, and that a run stops and goes on."""

import numpy as np
import pytest
import torch

from geomtact.geometry.distance import PoseDistance
from geomtact.scoring.resnet import load_resnet, make_network
from geomtact.training.thesis import FAR, NEAR, Settings, make_pairs, pair_loss, train_thesis

TINY = Settings(pairs=8, batch=4, side=32)


def test_the_loss_is_equation_1():
    similarity = torch.tensor([0.95, 0.2, 0.1, 0.3, 0.31, 0.9])
    label = torch.tensor([1.0, 0.9, 0.0, 0.0, 0.0, 0.0])
    expected = [0.05**2, 0.7**2, 0, 0, 0.31**2, 0.81]
    assert pair_loss(similarity, label).tolist() == pytest.approx(expected, abs=1e-6)


def test_pairs_are_labelled_by_the_distance_of_their_poses(plug):
    pairs = make_pairs(plug.space, 60, seed=2)
    positive = pairs.label > 0
    assert len(pairs.label) == 60 and 0.2 < positive.mean() < 0.9
    assert ((pairs.label[positive] > 0.9) & (pairs.label[positive] <= 1)).all()
    iou = (pairs.left & pairs.right).sum((1, 2)) / np.maximum((pairs.left | pairs.right).sum((1, 2)), 1)
    assert np.median(iou[positive]) > np.median(iou[~positive])
    again = make_pairs(plug.space, 60, seed=2)
    assert (again.left == pairs.left).all() and (again.label == pairs.label).all()
    assert PoseDistance(plug.mesh).mesh is plug.mesh and NEAR < FAR


def test_the_network_has_an_identity_at_its_end_and_1000_numbers():
    torch.manual_seed(0)
    network = make_network().eval()
    with torch.inference_mode():
        before = network[:-3](torch.rand(2, 3, 64, 64))
        out = network(torch.rand(2, 3, 64, 64))
    assert out.shape == (2, 1000) and before.shape == (2, 2048, 2, 2)
    assert (before < 0).any(), "a ReLU would have left nothing below 0"
    # He et al., table 1: 3.8 thousand million multiplications; 25.6 million weights
    assert sum(p.numel() for p in network.parameters()) == 25_557_032


@pytest.mark.slow
def test_a_stopped_run_goes_on_and_its_weights_score(plug, tmp_path, cache_dir, make_localizer):
    class Stopped(Exception):
        pass

    def stop(done, step):
        if "ResNet" in step and done > 0.4:
            raise Stopped

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train_thesis(plug.space, TINY, whole, tmp_path / "a.safetensors")
    from geomtact.training import thesis

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(thesis, "_SAVE_EVERY", 1)
        with pytest.raises(Stopped):
            train_thesis(plug.space, TINY, parts, tmp_path / "b.safetensors", stop)
        assert not (tmp_path / "b.safetensors").exists()
        train_thesis(plug.space, TINY, parts, tmp_path / "b.safetensors")
    a, b = load_resnet(tmp_path / "a.safetensors"), load_resnet(tmp_path / "b.safetensors")
    assert a.side == 32
    for x, y in zip(a.network.parameters(), b.network.parameters(), strict=True):
        assert torch.allclose(x, y, atol=1e-3)
    masks = plug.index.masks(np.arange(5))
    vectors = a.describe(masks, plug.sensor)
    assert vectors.shape == (5, 1000) and np.linalg.norm(vectors, axis=1) == pytest.approx(np.ones(5), abs=1e-3)

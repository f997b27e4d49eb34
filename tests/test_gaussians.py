"""The second noun: disk round trips, subsets and unions that keep fields together, poses that move parts."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from hingesplat import se3
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians, concatenate, posed
from hingesplat.screw import revolute


def make(n: int = 8, degree: int = 2) -> Gaussians:
    g = torch.Generator().manual_seed(n)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, (degree + 1) ** 2, 3)]
    return Gaussians(*(torch.randn(s, generator=g) for s in shapes), torch.arange(n) % 3)


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    for f in fields(Gaussians):
        torch.testing.assert_close(getattr(a, f.name), getattr(b, f.name), rtol=0, atol=0)


def test_scales_and_opacities_are_in_range_and_the_degree_is_read_off() -> None:
    a = make()
    assert len(a) == 8
    assert (a.scales > 0).all()
    assert ((a.opacities > 0) & (a.opacities < 1)).all()
    assert [make(degree=d).sh_degree for d in range(4)] == [0, 1, 2, 3]


def test_masks_and_unions_keep_the_fields_together() -> None:
    a = make()
    parts = concatenate([a[a.part == k] for k in range(3)])
    order = torch.argsort(a.part, stable=True)
    assert_equal(parts, a[order])


def test_detached_shares_nothing() -> None:
    a = make()
    a.means.requires_grad_()
    b = a.detached()
    assert not b.means.requires_grad
    b.means += 1
    assert (a.means != b.means).all()


def test_saving_and_loading_is_exact_and_leaves_one_file(tmp_path: Path) -> None:
    a = make()
    a.means.requires_grad_()
    a.save(tmp_path / "fit.safetensors")
    assert_equal(Gaussians.load(tmp_path / "fit.safetensors"), a.detached())
    assert [p.name for p in tmp_path.iterdir()] == ["fit.safetensors"]


def test_files_that_are_missing_broken_or_foreign_get_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "fit.safetensors"
    with pytest.raises(HingesplatError, match=r"fit\.safetensors: no such file"):
        Gaussians.load(path)
    save_file({"means": torch.zeros(2, 3)}, str(path))
    with pytest.raises(HingesplatError, match="lacks quats, log_scales"):
        Gaussians.load(path)
    make().save(path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(HingesplatError, match=r"fit\.safetensors: not a readable safetensors file"):
        Gaussians.load(path)


def test_posing_moves_only_the_named_part_and_turns_its_covariance() -> None:
    a = make()
    T = torch.from_numpy(revolute((1, 2, 3), (0.5, 0, 0), 1.1)).float()
    b = posed(a, {1: T.double().numpy()})
    moved = a.part == 1
    assert_equal(b[~moved], a[~moved])
    torch.testing.assert_close(b.means[moved], se3.apply(T, a.means[moved]))
    R = T[:3, :3]
    torch.testing.assert_close(covariance(b)[moved], R @ covariance(a)[moved] @ R.T)


def covariance(a: Gaussians) -> torch.Tensor:
    L = se3.wxyz_to_matrix(a.quats) * a.scales[:, None]
    return L @ L.transpose(-1, -2)

"""The second noun: 3D Gaussians, with what a twin needs to know of each."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from hingesplat import se3
from hingesplat.errors import HingesplatError
from hingesplat.files import whole_file

SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic


@dataclass
class Gaussians:
    """n anisotropic 3D Gaussians in the world frame, parametrised for unconstrained optimisation.

    Colour is spherical harmonics: ``sh`` is (n, (degree+1)², 3), and rgb = 0.5 + Σ basis·sh, clamped at 0.
    ``part`` (n,) int64 is the part id of each Gaussian (0 = the static base).
    """

    means: Tensor
    """(n, 3) centres, scene units."""
    quats: Tensor
    """(n, 4) wxyz, any non-zero length."""
    log_scales: Tensor
    """(n, 3) natural log of the standard deviations."""
    logit_opacities: Tensor
    """(n,) inverse sigmoid of the opacity."""
    sh: Tensor
    """(n, (degree+1)², 3) spherical-harmonic coefficients."""
    part: Tensor
    """(n,) int64 part id."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """(n, 3) standard deviations."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """(n,) in (0, 1)."""
        return self.logit_opacities.sigmoid()

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    def __getitem__(self, index: Tensor) -> "Gaussians":
        """A subset: boolean mask or index tensor."""
        return Gaussians(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def detached(self) -> "Gaussians":
        """A copy without gradients, sharing no memory with the original."""
        return Gaussians(**{f.name: getattr(self, f.name).detach().clone() for f in fields(self)})

    def to(self, device: torch.device | str) -> "Gaussians":
        """The same Gaussians on a device; tensors that are there already are shared."""
        return Gaussians(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def with_part(self, part: Tensor) -> "Gaussians":
        return replace(self, part=part)

    def save(self, path: Path) -> None:
        """Write a safetensors file, whole or not at all."""
        with whole_file(path) as tmp:
            save_file({f.name: getattr(self, f.name).detach().contiguous() for f in fields(self)}, str(tmp))

    @staticmethod
    def load(path: Path) -> "Gaussians":
        """Read what ``save`` wrote.

        Raises:
            HingesplatError: the file is missing, broken or lacks a tensor.
        """
        if not path.is_file():
            raise HingesplatError(f"{path}: no such file; run the stage that writes it first")
        try:
            tensors = load_file(str(path))
        except SafetensorError as e:
            raise HingesplatError(f"{path}: not a readable safetensors file; run the stage that writes it again") from e
        missing = [f.name for f in fields(Gaussians) if f.name not in tensors]
        if missing:
            raise HingesplatError(f"{path}: lacks {', '.join(missing)}; it was not written by this version")
        return Gaussians(**{f.name: tensors[f.name] for f in fields(Gaussians)})


def concatenate(groups: list[Gaussians]) -> Gaussians:
    """All Gaussians of several groups in order; sh degrees must agree."""
    return Gaussians(**{f.name: torch.cat([getattr(g, f.name) for g in groups]) for f in fields(Gaussians)})


def posed(gaussians: Gaussians, transforms: Mapping[int, np.ndarray]) -> Gaussians:
    """Each part moved rigidly: ``{part id: 4×4}``, as ``Twin.transforms`` gives them; parts not named stay.

    Centres and orientations move. Spherical harmonics above degree 0 keep their lobes in the world frame, so
    view-dependent colour does not turn with the part.
    """
    means, quats = gaussians.means.clone(), gaussians.quats.clone()
    for part_id, T in transforms.items():
        rows = gaussians.part == part_id
        if rows.any():
            T_world_part = torch.as_tensor(T, dtype=torch.float64, device=means.device)
            turn = se3.matrix_to_wxyz(T_world_part[:3, :3]).to(quats.dtype)
            means[rows] = se3.apply(T_world_part.to(means.dtype), means[rows])
            quats[rows] = se3.quat_multiply(turn.expand_as(quats[rows]), quats[rows])
    return replace(gaussians, means=means, quats=quats)

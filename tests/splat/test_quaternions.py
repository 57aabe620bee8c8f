"""Rotation matrices of quaternions: of unit ones gsplat's, and the cases that it leaves open."""

from __future__ import annotations

import torch
from gsplat.cuda._torch_impl import _quat_to_rotmat

from xrgs.splat.quaternions import rotation_matrices


def test_matrices_and_gradients_are_gsplats() -> None:
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(50, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(50, 3, 3, generator=generator, dtype=torch.float64)
    matrices, expected = rotation_matrices(quats), _quat_to_rotmat(quats)
    torch.testing.assert_close(matrices, expected, rtol=0, atol=1e-14)
    (gradient,) = torch.autograd.grad((matrices * weights).sum(), quats)
    (expected_gradient,) = torch.autograd.grad((expected * weights).sum(), quats)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-11, atol=1e-12)


def test_zero_quaternion_is_no_rotation_and_has_no_gradient() -> None:
    quats = torch.zeros(2, 4, requires_grad=True)
    matrices = rotation_matrices(quats)
    assert torch.equal(matrices, torch.eye(3).expand(2, 3, 3))
    torch.autograd.backward((matrices * torch.randn(2, 3, 3)).sum())
    assert quats.grad is not None
    assert torch.equal(quats.grad, torch.zeros(2, 4))

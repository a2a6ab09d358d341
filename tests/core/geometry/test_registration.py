"""Registration of 3D-3D pairs: exact without noise, bears outliers, names the degenerate."""

import numpy as np
import pytest

from dyfn_core.geometry.registration import (
    RegistrationError,
    Similarity,
    procrustes,
    ransac_procrustes,
)


def motion(rng: np.random.Generator, scale: float = 1.0) -> Similarity:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    return Similarity(q, rng.normal(size=3), scale)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [1.0, 0.3, 4.0])
def test_procrustes_recovers_the_motion_exactly(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    true = motion(rng, scale)
    points = rng.normal((0, 0, 5), size=(50, 3))
    found = procrustes(points, true.apply(points), with_scale=True)
    np.testing.assert_allclose(found.matrix, true.matrix, rtol=0, atol=1e-9)
    rigid = procrustes(points, motion(rng).apply(points))
    assert rigid.scale == 1.0
    if scale == 1.0:
        found = procrustes(points, true.apply(points))
        np.testing.assert_allclose(found.matrix, true.matrix, rtol=0, atol=1e-9)


def test_points_of_a_plane_fix_a_rotation_and_no_reflection() -> None:
    rng = np.random.default_rng(1)
    plane = np.concatenate([rng.normal(size=(20, 2)), np.ones((20, 1))], axis=1)
    true = motion(rng)
    found = procrustes(plane, true.apply(plane))
    np.testing.assert_allclose(found.matrix, true.matrix, rtol=0, atol=1e-9)
    mirrored = procrustes(rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1)


@pytest.mark.parametrize("with_scale", [False, True])
def test_ransac_bears_sixty_percent_outliers(with_scale: bool) -> None:
    rng = np.random.default_rng(2)
    true = motion(rng, 1.7 if with_scale else 1.0)
    points = rng.uniform([-2, -1, 1], [2, 1, 6], (500, 3))
    target = true.apply(points)
    wrong = rng.permutation(500)[:300]
    target[wrong] += rng.uniform(0.5, 3, (300, 3)) * rng.choice([-1, 1], (300, 3))
    found = ransac_procrustes(points, target, 0.02, with_scale=with_scale, seed=5)
    assert set(np.flatnonzero(~found.inliers)) == set(wrong)
    np.testing.assert_allclose(found.transform.matrix, true.matrix, rtol=0, atol=1e-9)
    again = ransac_procrustes(points, target, 0.02, with_scale=with_scale, seed=5)
    np.testing.assert_array_equal(again.transform.matrix, found.transform.matrix)


def test_thresholds_of_their_own_keep_noisy_far_pairs() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -1, 1], [2, 1, 9], (400, 3))
    true = motion(rng)
    noise = rng.uniform(-1, 1, (400, 3)) * 0.02 * points[:, 2:]
    found = ransac_procrustes(points, true.apply(points) + noise, 0.04 * points[:, 2])
    assert found.inliers.mean() > 0.98
    np.testing.assert_allclose(found.transform.matrix, true.matrix, rtol=0, atol=0.03)


def test_degenerate_pairs_are_named() -> None:
    rng = np.random.default_rng(4)
    line = np.linspace(1, 5, 100)[:, None] * [0.2, 0.1, 1.0]
    cloud = rng.normal(size=(100, 3))
    with pytest.raises(RegistrationError, match="too few pairs: 2"):
        procrustes(cloud[:2], cloud[:2])
    for degenerate in (line, np.ones((100, 3))):
        with pytest.raises(RegistrationError, match="collinear"):
            procrustes(degenerate, degenerate)
    with pytest.raises(RegistrationError, match="collinear"):
        ransac_procrustes(line + rng.normal(0, 1e-4, line.shape), line, 0.1)
    with pytest.raises(RegistrationError, match="no consensus"):
        ransac_procrustes(np.ones((100, 3)), cloud, 0.1)
    with pytest.raises(RegistrationError, match="too few pairs: 10"):
        ransac_procrustes(cloud[:10], cloud[:10], 0.1)
    with pytest.raises(RegistrationError, match="no consensus"):
        ransac_procrustes(cloud, rng.normal(size=(100, 3)), 0.05)
    with pytest.raises(ValueError, match="N x 3"):
        procrustes(cloud, cloud[:5])
    with pytest.raises(ValueError, match="finite"):
        procrustes(cloud, cloud * np.nan)


def test_similarities_compose_and_invert() -> None:
    rng = np.random.default_rng(5)
    a, b = motion(rng, 2.0), motion(rng, 0.7)
    points = rng.normal(size=(4, 7, 3))
    np.testing.assert_allclose(a.after(b).apply(points), a.apply(b.apply(points)))
    np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points)
    np.testing.assert_allclose(Similarity.from_matrix(a.matrix).matrix, a.matrix)
    assert np.array_equal(Similarity.identity().matrix, np.eye(4))

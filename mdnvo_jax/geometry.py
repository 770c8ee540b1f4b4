"""Rigid motions: step vectors, SE(3), poses along a path and their covariances.

A step is a 6-vector (tx, ty, tz, rx, ry, rz): translation in metres, in the axes of the earlier camera (x right,
y down, z forward), and rotation vector in radians. Its matrix `T_{t-1,t}` maps points from the later frame to the
earlier one. Covariances are 6x6 in the order (translation, rotation), of a right perturbation xi: T = T_mean @ exp(xi).

All functions take leading batch axes `...` and check the trailing ones (ValueError). Numpy arrays are computed by
numpy in float64; anything else by JAX in its own precision (float32 at least) under jit, vmap and grad. Values and
gradients are exact at and near zero rotation.

>>> import numpy as np
>>> turn = np.array([0.0, 0.0, 1.0, 0.0, np.pi / 2, 0.0])  # a metre ahead, then a quarter turn to the right
>>> poses = accumulate(step_to_matrix(np.stack([turn] * 4)))
>>> (poses[:, [0, 2], 3].round(6) + 0.0).tolist()  # x and z: round a square, back to the start
[[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]
"""

import math
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Array = TypeVar("Array", np.ndarray, jax.Array)

_MIRROR = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])


def hat(vector: Array) -> Array:
    """Matrix `[..., 3, 3]` whose product with b is the cross product of `vector` `[..., 3]` with b."""
    xp, vector = _inputs((vector, (3,)))
    x, y, z = (vector[..., i] for i in range(3))
    zero = xp.zeros_like(x)
    return xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape, 3)


def exp_so3(vector: Array) -> Array:
    """Rotation matrix `[..., 3, 3]` of a rotation vector `[..., 3]` in radians (Rodrigues)."""
    xp, vector = _inputs((vector, (3,)))
    squared = _squared_norm(vector)
    return _polynomial(xp, vector, _stumpff(xp, 1, squared), _stumpff(xp, 2, squared))


def log_so3(R: Array) -> Array:
    """Rotation vector `[..., 3]`, of length up to pi, of a rotation matrix `[..., 3, 3]`.

    Goes through the quaternion, which loses digits neither near zero nor near pi. At pi exactly both signs of the axis
    are right, and one is given; the gradient is finite there too.
    """
    xp, R = _inputs((R, (3, 3)))
    quaternion = quaternion_from_matrix(R)
    vector, w = quaternion[..., :3], quaternion[..., 3:]
    squared = (vector * vector).sum(-1)[..., None]
    # angle / 2 = atan2(sine, w). Its ratio to the sine is a series in (sine / w)^2 where that is small.
    is_small = squared < 0.01 * w * w
    safe_w = xp.where(is_small, w, 1)
    ratio = squared / (safe_w * safe_w)
    series = sum((-ratio) ** k / (2 * k + 1) for k in range(8)) / safe_w
    sine = xp.sqrt(xp.where(is_small, 1, squared))
    return 2 * vector * xp.where(is_small, series, xp.arctan2(sine, w) / sine)


def right_jacobian_so3(vector: Array) -> Array:
    """J_r `[..., 3, 3]` with exp(r + d) = exp(r) exp(J_r(r) d) to first order; the left one is J_r(-r)."""
    xp, vector = _inputs((vector, (3,)))
    squared = _squared_norm(vector)
    return _polynomial(xp, vector, -_stumpff(xp, 2, squared), _stumpff(xp, 3, squared))


def right_jacobian_inverse_so3(vector: Array) -> Array:
    """Inverse of `right_jacobian_so3`, `[..., 3, 3]`, for angles below 2 pi."""
    xp, vector = _inputs((vector, (3,)))
    squared = _squared_norm(vector)
    # (1 - (angle / 2) cot(angle / 2)) / angle^2, in the form that has no 0 / 0.
    c2, c3, c4 = (_stumpff(xp, order, squared) for order in (2, 3, 4))
    return _polynomial(xp, vector, xp.full_like(c2, 0.5), (c3 / 2 - c4) / c2)


def step_to_matrix(step: Array) -> Array:
    """`T_{t-1,t}` `[..., 4, 4]` of a step `[..., 6]`."""
    xp, step = _inputs((step, (6,)))
    return _rigid(xp, exp_so3(step[..., 3:]), step[..., :3])


def matrix_to_step(T: Array) -> Array:
    """Step `[..., 6]` of its matrix `[..., 4, 4]`; inverse of `step_to_matrix` for angles up to pi."""
    xp, T = _inputs((T, (4, 4)))
    return xp.concatenate([T[..., :3, 3], log_so3(T[..., :3, :3])], axis=-1)


def inverse(T: Array) -> Array:
    """Inverse of rigid motions `[..., 4, 4]`."""
    xp, T = _inputs((T, (4, 4)))
    R_inverse = _transpose(T[..., :3, :3])
    return _rigid(xp, R_inverse, -_apply(R_inverse, T[..., :3, 3]))


def compose(a: Array, b: Array) -> Array:
    """`a @ b`: first `b`, then `a`; `[..., 4, 4]`, at full precision on every accelerator."""
    xp, a, b = _inputs((a, (4, 4)), (b, (4, 4)))
    return _matmul(xp, a, b)


def adjoint(T: Array) -> Array:
    """Ad(T) `[..., 6, 6]` with T exp(xi) T^-1 = exp(Ad(T) xi), in the order (translation, rotation)."""
    xp, T = _inputs((T, (4, 4)))
    R = T[..., :3, :3]
    return _blocks(xp, R, _matmul(xp, hat(T[..., :3, 3]), R), xp.zeros_like(R), R)


def exp_se3(xi: Array) -> Array:
    """Exponential map of SE(3), `[..., 6]` to `[..., 4, 4]`: of (rho, phi) the translation is J_l(phi) rho."""
    xp, xi = _inputs((xi, (6,)))
    rho, phi = xi[..., :3], xi[..., 3:]
    return _rigid(xp, exp_so3(phi), _apply(right_jacobian_so3(-phi), rho))


def log_se3(T: Array) -> Array:
    """Inverse of `exp_se3`, `[..., 4, 4]` to `[..., 6]`, for angles up to pi."""
    xp, T = _inputs((T, (4, 4)))
    phi = log_so3(T[..., :3, :3])
    return xp.concatenate([_apply(right_jacobian_inverse_so3(-phi), T[..., :3, 3]), phi], axis=-1)


def project_to_so3(R: Array) -> Array:
    """The rotation nearest to `[..., 3, 3]` in the Frobenius norm, by its singular value decomposition.

    For matrices that are rotations up to rounding, as in files. Not differentiable: the singular values are equal.
    """
    xp, R = _inputs((R, (3, 3)))
    U, _, Vt = xp.linalg.svd(R)
    # Without the sign a reflection would be nearest to a matrix of negative determinant.
    sign = xp.where(xp.linalg.det(_matmul(xp, U, Vt)) < 0, -1, 1)[..., None]
    U = xp.concatenate([U[..., :2], U[..., 2:] * sign[..., None]], axis=-1)
    return _matmul(xp, U, Vt)


def quaternion_from_matrix(R: Array) -> Array:
    """Unit quaternion (x, y, z, w), w >= 0, `[..., 4]`, of a rotation matrix `[..., 3, 3]`.

    Every row of 4 q q^T, which is linear in R, is a multiple of q; the one with the largest diagonal entry is taken.
    """
    xp, R = _inputs((R, (3, 3)))
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = ([R[..., i, j] for j in range(3)] for i in range(3))
    xx, yy, zz, ww = 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22, 1 + r00 + r11 + r22
    xy, xz, yz, wx, wy, wz = r01 + r10, r02 + r20, r12 + r21, r21 - r12, r02 - r20, r10 - r01
    outer = xp.stack([xx, xy, xz, wx, xy, yy, yz, wy, xz, yz, zz, wz, wx, wy, wz, ww], axis=-1)
    largest = xp.argmax(xp.stack([xx, yy, zz, ww], axis=-1), axis=-1)[..., None, None]
    row = xp.take_along_axis(outer.reshape(*R.shape[:-2], 4, 4), largest, axis=-2)[..., 0, :]
    return row / xp.sqrt((row * row).sum(-1))[..., None] * xp.where(row[..., 3:] < 0, -1, 1)


def matrix_from_quaternion(quaternion: Array) -> Array:
    """Rotation matrix `[..., 3, 3]` of a quaternion (x, y, z, w) `[..., 4]`, of any length but zero."""
    xp, quaternion = _inputs((quaternion, (4,)))
    quaternion = quaternion / xp.sqrt((quaternion * quaternion).sum(-1))[..., None]
    vector, w = quaternion[..., :3], quaternion[..., 3:]
    return _polynomial(xp, vector, 2 * w[..., None], xp.full_like(w, 2)[..., None])


def mirror_step(step: Array) -> Array:
    """The step `[..., 6]` that a left-right mirrored film shows: S T S with S = diag(-1, 1, 1, 1)."""
    xp, step = _inputs((step, (6,)))
    return step * xp.asarray(_MIRROR, step.dtype)


def reverse_step(step: Array) -> Array:
    """The step `[..., 6]` that a film played backwards shows: the inverse motion."""
    xp, step = _inputs((step, (6,)))
    rotation = -step[..., 3:]
    return xp.concatenate([-_apply(exp_so3(rotation), step[..., :3]), rotation], axis=-1)


def accumulate(T_steps: Array, first: Array | None = None) -> Array:
    """Poses `T_world_camera` `[..., N + 1, 4, 4]` of the steps `[..., N, 4, 4]`, equation 8.

    T_world_t = T_world_{t-1} @ T_{t-1,t}: with steps that map later frames to earlier ones, the newest factor stands
    on the right, where the paper, whose steps map the other way, prints it on the left. JAX composes by an
    associative scan, numpy one after the other.

    Args:
      T_steps: the steps in order.
      first: the pose before them, `[..., 4, 4]`; the identity when None.
    """
    identity = np.eye(4, dtype=np.float32)
    xp, T_steps, first = _inputs((T_steps, (None, 4, 4)), (identity if first is None else first, (4, 4)))
    first = xp.broadcast_to(first, (*T_steps.shape[:-3], 4, 4))[..., None, :, :]
    chain = xp.concatenate([first, T_steps], axis=-3)
    if xp is jnp:
        return jax.lax.associative_scan(lambda a, b: _matmul(jnp, a, b), chain, axis=chain.ndim - 3)
    for index in range(1, chain.shape[-3]):
        chain[..., index, :, :] = chain[..., index - 1, :, :] @ chain[..., index, :, :]
    return chain


def relative_steps(poses: Array) -> Array:
    """Steps `T_{t-1,t}` = inv(T_world_{t-1}) @ T_world_t, `[..., N - 1, 4, 4]`, of poses `[..., N, 4, 4]`."""
    _, poses = _inputs((poses, (None, 4, 4)))
    return compose(inverse(poses[..., :-1, :, :]), poses[..., 1:, :, :])


def step_covariance_to_perturbation(step: Array, covariance: Array) -> Array:
    """Covariance of a step's vector to covariance of its right perturbation, both `[..., 6, 6]`; to first order."""
    xp, step, covariance = _inputs((step, (6,)), (covariance, (6, 6)))
    return _sandwich(xp, step_jacobian(step), covariance)


def step_jacobian(step: Array) -> Array:
    """`[..., 6, 6]`: moving the step `[..., 6]` by (dt, dr) is the right perturbation (R^T dt, J_r(r) dr)."""
    xp, step = _inputs((step, (6,)))
    rotation = step[..., 3:]
    zero = xp.zeros_like(hat(rotation))
    return _blocks(xp, exp_so3(-rotation), zero, zero, right_jacobian_so3(rotation))


def propagate_covariance(
    T_steps: Array, step_covariances: Array, *, order: Literal[1, 2] = 1, initial: Array | None = None
) -> Array:
    """Covariance of every pose along a path of independent steps, right perturbations throughout.

    Order 1: P_t = F P_{t-1} F^T + Q_t with F = Ad(T_{t-1,t}^-1), by an associative scan. Order 2 adds the terms of
    fourth order in the perturbations, which large rotation noise needs, one step after the other: Barfoot and Furgale,
    "Associating uncertainty with three-dimensional poses for use in estimation problems", IEEE T-RO 30(3), 2014.

    Args:
      T_steps: mean steps `[..., N, 4, 4]`.
      step_covariances: of their right perturbations `[..., N, 6, 6]`, see `step_covariance_to_perturbation`.
      order: 1 or 2.
      initial: covariance of the first pose `[..., 6, 6]`; zero when None.

    Returns:
      Covariances of the N + 1 poses of `accumulate`, `[..., N + 1, 6, 6]`.

    Raises:
      ValueError: shapes disagree, or `order` is neither 1 nor 2.
    """
    zero = np.zeros((6, 6), np.float32)
    noise: Any
    covariances: Any
    xp, T_steps, noise, start = _inputs(
        (T_steps, (None, 4, 4)), (step_covariances, (None, 6, 6)), (zero if initial is None else initial, (6, 6))
    )
    if order not in (1, 2):
        raise ValueError(f"order is {order}; expected 1 or 2")
    if T_steps.shape[:-2] != noise.shape[:-2]:
        raise ValueError(f"steps {T_steps.shape[:-2]} and covariances {noise.shape[:-2]}; expected one a step")
    start = xp.broadcast_to(start, (*noise.shape[:-3], 6, 6))
    # Steps to the front, for scans; what each does to a perturbation of the pose before it.
    carry, added = xp.moveaxis(adjoint(inverse(T_steps)), -3, 0), xp.moveaxis(noise, -3, 0)

    def advance(before: Any, step: tuple[Any, Any]) -> Any:
        return _compound(xp, _sandwich(xp, step[0], before), step[1], order)

    if xp is np or order == 2:
        covariances = _along(xp, advance, start, (carry, added))
    else:
        identity = jnp.broadcast_to(jnp.eye(6, dtype=start.dtype), start.shape)
        chain = (jnp.concatenate([identity[None], carry]), jnp.concatenate([start[None], added]))
        _, covariances = jax.lax.associative_scan(_then, chain)
    return xp.moveaxis((covariances + _transpose(covariances)) / 2, 0, -3)


def scale_covariance(poses: Array, sigma: float) -> Array:
    """Covariance `[..., N, 6, 6]` that one error of scale, common to all steps, gives poses `[..., N, 4, 4]` of a path.

    True translations are (1 + e) times the given ones, with one e of standard deviation `sigma` for the whole path. The
    pose j then lies e (p_j - p_0) further from the first one and is turned as it was: a right perturbation e J_j with
    J_j = (R_j^T (p_j - p_0), 0), of covariance sigma^2 J_j J_j^T; exact, not only to first order. It is added to
    what `propagate_covariance` gives, in which the errors of steps are independent and average out.
    """
    xp, poses = _inputs((poses, (None, 4, 4)))
    moved = _apply(_transpose(poses[..., :3, :3]), poses[..., :3, 3] - poses[..., :1, :3, 3])
    direction = sigma * xp.concatenate([moved, xp.zeros_like(moved)], axis=-1)
    return direction[..., :, None] * direction[..., None, :]


def shared_covariance(poses: Array, directions: Array) -> Array:
    """Covariance `[..., N + 1, 6, 6]` that errors which all steps share give the poses `[..., N + 1, 4, 4]` of a path.

    The right perturbation of step k is D_k e, with one e ~ N(0, I) for the whole path; D `[..., N, 6, M]`. To first
    order that of pose j is J_j e with J_j = Ad(T_j^-1) sum_{k <= j} Ad(T_k) D_k, and its covariance J_j J_j^T.
    """
    xp, poses, directions = _inputs((poses, (None, 4, 4)), (directions, (None, 6, None)))
    in_world = xp.cumsum(_matmul(xp, adjoint(poses[..., 1:, :, :]), directions), axis=-3)
    jacobian = _matmul(xp, adjoint(inverse(poses[..., 1:, :, :])), in_world)
    zero = xp.zeros_like(poses[..., :1, :1, :1]) * xp.zeros((6, 6), poses.dtype)
    return xp.concatenate([zero, _matmul(xp, jacobian, _transpose(jacobian))], axis=-3)


def serial_covariance(T_steps: Array, directions: Array, correlation: Array) -> Array:
    """Covariance that poses gain, `[..., N + 1, 6, 6]`, because errors of neighbouring steps are alike.

    The right perturbation of step k is D_k e_k, D `[..., N, 6, M]`, where e `[M]` is an autoregressive process of first
    order: each e_m ~ N(0, 1), and of any two steps E[e_mk e_ml] = r_m^|k - l|, r `[M]` from 0 to 1. Steps by themselves
    (k = l) are left out: those are `propagate_covariance`'s. With F_k = Ad(T_{k-1,k}^-1) and X_k = cov(pose k, e_k),

        S_k = F_k S_{k-1} F_k^T + Y_k + Y_k^T,   Y_k = F_k X_{k-1} R D_k^T,   X_k = F_k X_{k-1} R + D_k,   R = diag(r).

    Args:
      T_steps: mean steps `[..., N, 4, 4]`.
      directions: D.
      correlation: r.
    """
    xp, T_steps, directions, decay = _inputs(
        (T_steps, (None, 4, 4)), (directions, (None, 6, None)), (correlation, (None,))
    )
    carry, added = xp.moveaxis(adjoint(inverse(T_steps)), -3, 0), xp.moveaxis(directions, -3, 0)

    def advance(before: tuple[Any, Any], step: tuple[Any, Any]) -> tuple[Any, Any]:
        gained, with_error = before
        F, D = step
        kept = _matmul(xp, F, with_error) * decay
        cross = _matmul(xp, kept, _transpose(D))
        return _sandwich(xp, F, gained) + cross + _transpose(cross), kept + D

    start = xp.zeros(carry.shape[1:], carry.dtype), xp.zeros(added.shape[1:], added.dtype)
    return xp.moveaxis(_along(xp, advance, start, (carry, added))[0], 0, -3)


def _along(xp: Any, advance: Callable[[Any, Any], Any], start: Any, steps: tuple[Any, ...]) -> Any:
    """The state, an array or a tuple of them, before the first step and after every one, on a new first axis."""
    if xp is np:
        states = [start]
        for step in zip(*steps, strict=True):
            states.append(advance(states[-1], step))
        return jax.tree.map(lambda *path: np.stack(path), *states)
    _, after = jax.lax.scan(lambda before, step: (advance(before, step),) * 2, start, steps)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)


def _then(earlier: tuple[Any, Any], later: tuple[Any, Any]) -> tuple[Any, Any]:
    """Two stretches of path as one: P -> F P F^T + Q composed with itself."""
    (F_earlier, Q_earlier), (F_later, Q_later) = earlier, later
    return _matmul(jnp, F_later, F_earlier), _sandwich(jnp, F_later, Q_earlier) + Q_later


def _compound(xp: Any, a: Any, b: Any, order: int) -> Any:
    """Covariance of log(exp(xi_a) exp(xi_b)) for independent xi of covariances a and b."""
    if order == 1:
        return a + b
    # Baker-Campbell-Hausdorff: xi_a + xi_b + [a, b] / 2 + [a, [a, b]] / 12 + [b, [b, a]] / 12, squared, in expectation.
    ad = xp.asarray(_little_adjoint(np.eye(6)), a.dtype)
    spread_a, spread_b = (_einsum(xp, "...ij,jkl->...ikl", covariance, ad) for covariance in (a, b))
    twice_a, twice_b = (_einsum(xp, "ikl,...ilm->...km", ad, spread) for spread in (spread_a, spread_b))
    single = _einsum(xp, "ikl,...ilm->...km", ad, _einsum(xp, "...lm,...inm->...iln", b, spread_a))
    double = _matmul(xp, twice_a, b) + _matmul(xp, twice_b, a)
    return a + b + single / 4 + (double + _transpose(double)) / 12


def _little_adjoint(xi: Any) -> Any:
    """Matrix of the Lie bracket of se(3), `[..., 6]` to `[..., 6, 6]`: adjoint(exp(xi)) = expm of it."""
    phi = hat(xi[..., 3:])
    return _blocks(np, phi, hat(xi[..., :3]), np.zeros_like(phi), phi)


def _stumpff(xp: Any, order: int, squared: Any) -> Any:
    """Stumpff function c_k(x) = sum_j (-x)^j / (2 j + k)! of x = angle^2.

    c_0 = cos(angle), c_1 = sin(angle) / angle, and c_{k+2} = (1 / k! - c_k) / x: the coefficients of every closed form
    on SO(3). By the series below an angle of one, where nine terms are exact in float64 and the recursion is not.
    """
    is_small = squared < 1
    near, far = xp.where(is_small, squared, 0), xp.where(is_small, 1, squared)
    series = xp.zeros_like(squared)
    for term in reversed(range(9)):
        series = 1 / math.factorial(2 * term + order) - near * series
    angle = xp.sqrt(far)
    closed = xp.sin(angle) / angle if order % 2 else xp.cos(angle)
    for lower in range(order % 2, order, 2):
        closed = (1 / math.factorial(lower) - closed) / far
    return xp.where(is_small, series, closed)


def _polynomial(xp: Any, vector: Any, linear: Any, quadratic: Any) -> Any:
    """I + linear hat(v) + quadratic hat(v)^2; the coefficients are `[..., 1, 1]`."""
    cross = hat(vector)
    return xp.eye(3, dtype=cross.dtype) + linear * cross + quadratic * _matmul(xp, cross, cross)


def _squared_norm(vector: Any) -> Any:
    return (vector * vector).sum(-1)[..., None, None]


def _rigid(xp: Any, R: Any, t: Any) -> Any:
    top = xp.concatenate([R, t[..., None]], axis=-1)
    bottom = xp.broadcast_to(xp.asarray([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, bottom], axis=-2)


def _blocks(xp: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    rows = (xp.concatenate([a, b], axis=-1), xp.concatenate([c, d], axis=-1))
    return xp.concatenate(rows, axis=-2)


def _apply(matrix: Any, vector: Any) -> Any:
    return (matrix * vector[..., None, :]).sum(-1)


def _transpose(matrix: Any) -> Any:
    return matrix.swapaxes(-1, -2)


def _sandwich(xp: Any, matrix: Any, covariance: Any) -> Any:
    return _matmul(xp, _matmul(xp, matrix, covariance), _transpose(matrix))


def _matmul(xp: Any, a: Any, b: Any) -> Any:
    # Accelerators otherwise multiply float32 in bfloat16 or tf32: metres off at the end of a kilometre.
    return np.matmul(a, b) if xp is np else jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _einsum(xp: Any, subscripts: str, *operands: Any) -> Any:
    if xp is np:
        return np.einsum(subscripts, *operands)
    return jnp.einsum(subscripts, *operands, precision=jax.lax.Precision.HIGHEST)


def _namespace(*arrays: Any) -> Any:
    return np if all(isinstance(array, np.ndarray | np.generic) for array in arrays) else jnp


def _inputs(*given: tuple[Any, tuple[int | None, ...]]) -> tuple[Any, ...]:
    """The namespace, then the arrays in one float type, once their trailing axes are as expected (None: any length)."""
    xp = _namespace(*(array for array, _ in given))
    arrays = [xp.asarray(array) for array, _ in given]
    for array, (_, trailing) in zip(arrays, given, strict=True):
        found = array.shape[-len(trailing) :]
        if len(found) != len(trailing) or any(n not in (None, m) for n, m in zip(trailing, found, strict=True)):
            expected = ", ".join("N" if n is None else str(n) for n in trailing)
            raise ValueError(f"found an array of shape {array.shape}; expected [..., {expected}]")
    dtype = np.float64 if xp is np else jnp.result_type(jnp.float32, *arrays)
    return xp, *(array.astype(dtype) for array in arrays)

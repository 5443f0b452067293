"""Levenberg-Marquardt on normal equations: Optimistix's loop, search and result codes, our solver and descent."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from hdev_jax.learn.narx.network import Shape
from hdev_jax.learn.narx.normal import Equations, Rows, Windows, one_step, simulated

__all__ = ["Fitted", "NormalLevenbergMarquardt", "fit_many"]


class _Damped(eqx.Module):
    info: Any


class MarquardtDescent(optx.AbstractDescent[Any, Any, Any]):
    """(H + λ·diag H)·d = −g by Cholesky: Marquardt's scaling, λ = 1/step size; Optimistix's own damps by λ·1."""

    def init(self, y: Any, f_info_struct: Any) -> _Damped:
        return _Damped(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), f_info_struct))

    def query(self, y: Any, f_info: Any, state: _Damped) -> _Damped:
        return _Damped(f_info)

    def step(self, step_size: Any, state: _Damped) -> tuple[Any, optx.RESULTS]:
        hessian = state.info.hessian.as_matrix()
        scale = jnp.diag(hessian)
        scale = scale + 1e-10 * jnp.max(scale) + jnp.finfo(scale.dtype).tiny
        factor = jnp.linalg.cholesky(hessian + jnp.diag(scale / step_size))
        move = -jax.scipy.linalg.cho_solve((factor, True), state.info.grad)
        # not positive definite to rounding: a step to infinity is turned down, and the next one is damped more
        return jnp.where(jnp.all(jnp.isfinite(move)), move, jnp.inf), optx.RESULTS.successful


class _State(eqx.Module):
    first: Bool[Array, ""]
    tried: Float[Array, " parameter"]
    search: Any
    info: Any
    descent: Any
    terminate: Bool[Array, ""]


class NormalLevenbergMarquardt(optx.AbstractLeastSquaresSolver[Any, Any, Any, _State]):
    """A least-squares solver that never holds the Jacobian: `equations(θ, args)` gives loss, gradient and Hessian.

    **Arguments:** `equations`, ½Σρ(r), its gradient and its Gauss-Newton Hessian; `rtol`, the solver stops when an
    accepted step lowers the loss by less than this share of it; `damping`, λ of the first step.
    """

    equations: Callable[[Any, Any], Equations]
    rtol: float = 1e-6
    atol: float = 0.0
    norm: Callable[[Any], Any] = optx.max_norm
    damping: float = 1e-3
    descent: MarquardtDescent = MarquardtDescent()
    search: optx.ClassicalTrustRegion[Any] = optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=1e-4)

    def _info(self, y: Any, args: Any) -> Any:
        loss, gradient, hessian = self.equations(y, args)
        # a step into the infinite is a step that did not help
        loss = jnp.where(jnp.isfinite(loss), loss, jnp.finfo(loss.dtype).max)
        operator = lx.MatrixLinearOperator(hessian, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(loss, gradient, operator)

    def init(self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> _State:
        struct = eqx.filter_eval_shape(self._info, y, args)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct)
        search = eqx.tree_at(lambda s: s.step_size, self.search.init(y, struct), jnp.asarray(1.0 / self.damping))
        return _State(jnp.array(True), y, search, empty, self.descent.init(y, struct), jnp.array(False))

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any) -> tuple[Any, _State, Any]:
        here = self._info(state.tried, args)
        size, accept, _, search = self.search.step(state.first, y, state.tried, state.info, here, state.search)
        small = jnp.abs(state.info.f - here.f) <= self.rtol * jnp.abs(here.f)
        done = accept & small & jnp.invert(state.first)
        best, info = jax.tree.map(lambda a, b: jnp.where(accept, a, b), (state.tried, here), (y, state.info))
        descent = self.descent.query(best, info, state.descent)
        move, _ = self.descent.step(size, descent)
        # once nothing is left to gain, no damping is enough to be let through
        done = done | (size < 1e-14)
        return best, _State(jnp.array(False), best + move, search, info, descent, done), None

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any) -> tuple[Any, Any]:
        return state.terminate, optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: _State, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {"loss": state.info.f}


class Fitted(eqx.Module):
    """What fits from several starts came to. `converged` is False where `max_steps` were not enough."""

    theta: Float[Array, "start parameter"]
    loss: Float[Array, " start"]
    steps: Int[Array, " start"]
    converged: Bool[Array, " start"]


def _penalised(shape: Shape, single: bool, theta: Array, args: Any) -> Equations:
    data, corner, ridge = args
    if isinstance(data, Rows):
        loss, gradient, hessian = one_step(shape, theta, data, corner, single=single)
    else:
        loss, gradient, hessian = simulated(shape, theta, data, corner, single=single)
    return loss + 0.5 * jnp.sum(ridge * theta**2), gradient + ridge * theta, hessian + jnp.diag(ridge)


@eqx.filter_jit
def fit_many(
    shape: Shape,
    data: Rows | Windows,
    starts: Float[Array, "start parameter"],
    *,
    huber: Any,
    ridge: Float[Array, " parameter"],
    max_steps: int = 100,
    rtol: float = 1e-6,
    weights: Float[Array, "start *shape"] | None = None,
    single: bool = False,
) -> Fitted:
    """Every start fitted in one program.

    Minimises ½Σ ρ(y − ŷ) + ½Σ ridge·θ², ρ of Huber with its corner at `huber` (in the unit of y; infinite: squares).

    **Arguments:** `data`: `Rows` for the one-step error, `Windows` for the free run; `weights`, in place of the data's
    own, different for each start: folds of a validation, side by side; `single`, products of the Hessian in float32:
    faster where there are many parameters, and a few more steps.
    """
    solver = NormalLevenbergMarquardt(equations=partial(_penalised, shape, single), rtol=rtol)  # pyright: ignore[reportCallIssue]
    corner = jnp.asarray(huber, dtype=starts.dtype)

    def one(theta: Array, own: Array | None) -> tuple[Array, ...]:
        given = data if own is None else eqx.tree_at(lambda d: d.weight, data, own)
        sol = optx.least_squares(
            lambda t, _: t, solver, theta, args=(given, corner, ridge), max_steps=max_steps, throw=False
        )
        return sol.value, sol.stats["loss"], sol.stats["num_steps"], sol.result == optx.RESULTS.successful

    return Fitted(*jax.vmap(one, in_axes=(0, None if weights is None else 0))(starts, weights))

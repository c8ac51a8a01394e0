"""From what a user names (an id, an instance, a factory) to functions that make one environment each."""

from __future__ import annotations

import contextlib
import copy
import difflib
import functools
import importlib
import importlib.util
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from tightrope.control.environments.faults import RAISED, fault_while, raised_here
from tightrope.control.spaces.actions import ActionLayout
from tightrope.control.spaces.observations import ObservationLayout
from tightrope.control.spaces.structure import bounds_of, structure

# namespace or entry point module -> the module that must be there, and our extra that installs it
EXTRAS = {
    "gymnasium.envs.box2d": ("Box2D", "box2d"),
    "gymnasium.envs.mujoco": ("mujoco", "mujoco"),
    "ale_py": ("ale_py", "atari"),
}
# Warnings of third parties while a standard task is built; a user can do nothing about them.
NOISE = (
    r".*precision lowered by casting.*",
    r".*pkg_resources is deprecated.*",
    r".*settotalmass.*",
    r"builtin type [Ss]wig\w* has no __module__ attribute",
)
# wrappers that gym.make adds or not, without effect on a task
BOOKKEEPING = ("OrderEnforcing", "PassiveEnvChecker")


def find_spec(env_id: str) -> EnvSpec | None:
    """The registered spec of an id, Atari included; None without one (yet: "module:Id" imports first)."""
    register_atari(env_id)
    return gym.registry.get(env_id.rpartition(":")[2])


def name_of(env: Any) -> str:
    """An id; the id of an environment object, else the name of its class or of the factory."""
    if isinstance(env, str):
        return env
    known = getattr(getattr(env, "spec", None), "id", None) or getattr(env, "__name__", None)
    return str(known or type(getattr(env, "unwrapped", env)).__name__)


def time_limit(env: Any) -> int | None:
    """The steps after which an id or an environment object truncates an episode; None: none, or unknown."""
    spec = find_spec(env) if isinstance(env, str) else getattr(env, "spec", None)
    return getattr(spec, "max_episode_steps", None)


def entry_module(spec: EnvSpec | None) -> str:
    """The module that a spec's entry point lies in, empty when unknown."""
    point = spec.entry_point if spec is not None else None
    return point.partition(":")[0] if isinstance(point, str) else getattr(point, "__module__", "") or ""


def register_atari(env_id: str) -> None:
    """Put Atari's ids into the registry when one is asked for and ale-py is there."""
    if not env_id.startswith("ALE/") or importlib.util.find_spec("ale_py") is None:
        return
    import ale_py

    if env_id not in gym.registry:
        gym.register_envs(ale_py)
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # its banner is no error of the user's


@contextlib.contextmanager
def without_noise(spec: EnvSpec | None = None) -> Iterator[None]:
    """Hide the known warnings of third parties while a task is built; every other warning passes."""
    with warnings.catch_warnings(), contextlib.ExitStack() as stack:
        for message in NOISE:
            warnings.filterwarnings("ignore", message=message)
        if entry_module(spec).startswith("gymnasium.envs.mujoco"):
            stack.enter_context(_mujoco_warnings())
        yield


@contextlib.contextmanager
def _mujoco_warnings() -> Iterator[None]:
    """Turn what MuJoCo prints from C, and writes to MUJOCO_LOG.TXT, into Python warnings."""
    try:
        import mujoco
    except ImportError:
        yield
        return
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: warnings.warn(message, stacklevel=2))
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def make_by_id(env_id: str, **keywords: Any) -> gym.Env:
    """``gym.make`` with helpful errors; checks of the first steps replace its passive checker."""
    return _explained(env_id, lambda: gym.make(env_id, disable_env_checker=True, **keywords))


def make_vector_by_id(env_id: str, num_envs: int) -> Any:
    """The task's own vector version, resetting in the same step where it can; ValueError without one."""
    spec = find_spec(env_id)
    if spec is None:
        make_by_id(env_id).close()  # raises for an unknown id; "module:Id" registers itself
        spec = find_spec(env_id)
    if spec is None or spec.vector_entry_point is None:
        raise ValueError(
            f"vector backend 'vector' asked for, but {env_id} has no vector version of its own. "
            "Use auto, serial or workers."
        )

    def make() -> Any:
        make_vec = functools.partial(gym.make_vec, env_id, num_envs, vectorization_mode="vector_entry_point")
        same_step: dict[str, Any] = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
        if env_id.startswith("ALE/"):
            same_step["reward_clipping"] = False  # returns are reported in the points of the game
        try:
            return _trusting(make_vec(**same_step))
        except TypeError as error:
            if "autoreset_mode" not in str(error):
                raise
        return _trusting(make_vec())

    return _explained(env_id, make)


class _AnyAction(gym.spaces.MultiDiscrete):
    """The same space without its membership test: an action layout gives valid actions by construction."""

    def contains(self, x: Any) -> bool:
        return True


def _trusting(env: Any) -> Any:
    """Skip the check of every action in a vector version that we made: a fifth of a CartPole step."""
    space = env.action_space
    if type(space) is gym.spaces.MultiDiscrete:
        env.action_space = _AnyAction(space.nvec, dtype=space.dtype, start=space.start)
    return env


def make_envpool(env_id: str, num_envs: int, seed: int, num_threads: int) -> Any:
    """EnvPool's version of a task; ValueError when EnvPool is missing or does not know the id."""
    try:
        import envpool
    except ImportError as error:
        raise ValueError(
            f"vector backend 'envpool' asked for, but EnvPool cannot be imported ({error}). "
            "Install it: pip install 'tightrope[envpool]'."
        ) from error
    known = envpool.list_all_envs()
    name = env_id.removeprefix("ALE/")
    if name not in known:
        raise ValueError(
            f"EnvPool has no task {name!r}.{_did_you_mean(name, known)} Or use another vector backend."
        )
    with without_noise():
        return envpool.make(name, env_type="gymnasium", num_envs=num_envs, seed=seed, num_threads=num_threads)


def _explained(env_id: str, make: Callable[[], Any]) -> Any:
    """What ``make`` returns; errors about the id or a missing package become a ValueError with advice."""
    spec = find_spec(env_id)
    try:
        with without_noise(spec):
            return make()
    except ModuleNotFoundError as error:
        module = env_id.partition(":")[0]
        if ":" in env_id and error.name in (None, module, module.partition(".")[0]):
            raise ValueError(
                f"{env_id!r}: no module named {module!r}. Is it installed, or on PYTHONPATH?"
            ) from error
        raise _missing(env_id, spec, error) from error
    except (gym.error.DependencyNotInstalled, ImportError) as error:
        raise _missing(env_id, spec, error) from error
    except gym.error.UnregisteredEnv as error:
        name = env_id.rpartition(":")[2]
        if name.startswith("ALE/") and importlib.util.find_spec("ale_py") is None:
            raise ValueError(f"{env_id} needs ale-py. Install it: pip install 'tightrope[atari]'.") from error
        raise ValueError(f"unknown environment id {env_id!r}.{_did_you_mean(name, gym.registry)}") from error
    except gym.error.Error as error:
        hint = _did_you_mean(env_id, gym.registry)
        raise ValueError(f"environment id {env_id!r} cannot be made: {error}.{hint}") from error


def _missing(env_id: str, spec: EnvSpec | None, error: Exception) -> ValueError:
    """The error for a task whose package is not installed, with the extra to install where we have one."""
    for prefix, (module, extra) in EXTRAS.items():
        if entry_module(spec).startswith(prefix) and importlib.util.find_spec(module) is None:
            return ValueError(f"{env_id} needs {module}. Install it: pip install 'tightrope[{extra}]'.")
    return ValueError(f"{env_id} cannot be made, something it needs is missing: {error}")


def _did_you_mean(name: str, known: Any) -> str:
    """`` Did you mean ...?`` over all known ids, whatever their case and version."""
    lowered = {str(key).lower(): str(key) for key in known}
    close = difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.6)
    stem = name.lower().rpartition("-v")[0] or name.lower()
    same = sorted((v for k, v in lowered.items() if k.rpartition("-v")[0] == stem), reverse=True)
    names = list(dict.fromkeys([*same, *(lowered[key] for key in close)]))[:3]
    return f" Did you mean {' or '.join(names)}?" if names else ""


def makers_of(env: Any, num_envs: int) -> list[Callable[[], gym.Env]]:
    """One function per copy of an id, an instance (it is copy 0 itself) or a factory. ValueError: neither."""
    if isinstance(env, str):
        return [lambda: make_by_id(env)] * num_envs
    if isinstance(env, gym.Env):
        return replicas(env, num_envs)
    if callable(env):
        return [env] * num_envs
    raise ValueError(
        f"env is a {type(env).__name__}; expected a Gymnasium id, an environment, a zero-argument "
        "factory or a vector environment."
    )


def make_all(makers: Sequence[Callable[[], gym.Env]], envs: list[gym.Env], first: int = 0) -> None:
    """Append one environment per maker to ``envs``; ``first``: the number of the first in the run.

    ValueError when a maker returns something else, or the same object twice. EnvironmentFault when the
    environment's own code raises.
    """
    for maker in makers:
        try:
            env = maker()
        except RAISED as error:
            if raised_here(error):
                raise
            raise fault_while("Making", first + len(envs), error) from error
        if not isinstance(env, gym.Env):
            raise ValueError(f"the factory returned a {type(env).__name__}; expected a gymnasium.Env.")
        if any(env is other for other in envs):
            raise ValueError(
                f"the factory returned the same object twice ({env}); each call must build a new environment."
            )
        envs.append(env)


def check_alike(
    envs: Sequence[gym.Env], observations: ObservationLayout, actions: ActionLayout, name: str
) -> None:
    """ValueError when the copies' observations or actions differ in shape, or the bounds of actions."""
    for env in envs:
        pairs = ((observations.space, env.observation_space), (actions.space, env.action_space))
        same = all(structure(ours) == structure(theirs) for ours, theirs in pairs)
        if not same or bounds_of(env.action_space) != bounds_of(actions.space):
            raise ValueError(
                f"the copies of {name} differ: {env.observation_space}, {env.action_space} against "
                f"{observations.space}, {actions.space}. All copies must have the same spaces."
            )


def replicas(env: gym.Env, num_envs: int) -> list[Callable[[], gym.Env]]:
    """One maker per copy of a given instance; the instance itself is copy 0.

    Copies come from ``gym.make(env.spec)`` when that rebuilds the same wrappers, else from ``copy.deepcopy``.
    ValueError: neither works.
    """
    makers: list[Callable[[], gym.Env]] = [lambda: env]
    if num_envs == 1:
        return makers
    return makers + [_replicator(env)] * (num_envs - 1)


def _replicator(env: gym.Env) -> Callable[[], gym.Env]:
    reasons = []
    for what, function in (("gym.make of its spec", _from_spec), ("copy.deepcopy", copy.deepcopy)):
        try:
            trial = function(env)
        except Exception as error:
            reasons.append(f"{what}: {type(error).__name__}: {error}")
            continue
        if trial is env or trial.unwrapped is env.unwrapped:
            reasons.append(f"{what} returned the same object")
            continue
        if function is _from_spec:
            trial.close()  # of a deep copy, close() might end what it shares with the original
        return lambda: function(env)
    raise ValueError(
        f"the environment {env} cannot be replicated ({'; '.join(reasons)}). "
        "Pass a zero-argument factory that builds it, or num_envs=1."
    )


def _from_spec(env: gym.Env) -> gym.Env:
    spec = env.spec
    if spec is None:
        raise ValueError("it has no spec")
    with without_noise(spec):
        twin = gym.make(spec, disable_env_checker=True)
    if _layers(twin) != _layers(env):
        twin.close()
        raise ValueError(f"gives {_layers(twin)}, the instance is {_layers(env)}")
    return twin


def _layers(env: gym.Env) -> list[str]:
    """The classes from the outermost wrapper to the task, bookkeeping left out."""
    names = []
    while True:
        names.append(f"{type(env).__module__}.{type(env).__qualname__}")
        if not isinstance(env, gym.Wrapper):
            return [name for name in names if name.rpartition(".")[2] not in BOOKKEEPING]
        env = env.env

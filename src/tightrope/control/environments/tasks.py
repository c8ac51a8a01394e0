"""From what a user names (an id, an instance, a factory) to functions that make one environment each."""

from __future__ import annotations

import contextlib
import copy
import difflib
import functools
import importlib
import importlib.util
import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.wrappers import TimeLimit

from tightrope.control.environments.faults import RAISED, EnvironmentTimeout, fault_while, raised_here
from tightrope.control.environments.state import nested

# namespace or entry point module -> the module that must be there, and our extra that installs it
EXTRAS = {
    "gymnasium.envs.box2d": ("Box2D", "box2d"),
    "gymnasium.envs.mujoco": ("mujoco", "mujoco"),
    "ale_py": ("ale_py", "atari"),
}
Limit = Callable[[str], contextlib.AbstractContextManager[Any]]
# Warnings of third parties while a standard task is built; a user can do nothing about them.
NOISE = (
    r".*precision lowered by casting.*",
    r".*pkg_resources is deprecated.*",
    r".*settotalmass.*",
    r"builtin type [Ss]wig\w* has no __module__ attribute",
)

# What a user may give as environment: a Gymnasium id, an environment, a class or a factory, or a vector
# environment.
EnvSource = str | gym.Env | Callable[..., gym.Env] | gym.vector.VectorEnv
_T = TypeVar("_T")


def find_spec(env_id: str) -> EnvSpec | None:
    """The registered spec of an id, Atari included; None without one (yet: "module:Id" imports first)."""
    register_atari(env_id)
    return gym.registry.get(env_id.rpartition(":")[2])


def name_of(env: EnvSource) -> str:
    """An id; the id of an environment object, else the name of its class or of the factory."""
    if isinstance(env, str):
        return env
    known = getattr(getattr(env, "spec", None), "id", None) or getattr(env, "__name__", None)
    return str(known or type(getattr(env, "unwrapped", env)).__name__)


def time_limit(env: EnvSource, keywords: Mapping[str, Any] | None = None) -> int | None:
    """The steps after which an id or an environment object truncates an episode; None: none, or unknown.

    An object's TimeLimit layers say it, else its spec. ``keywords``: for gym.make, which takes another limit.
    """
    if isinstance(env, gym.Env):
        limits = [layer._max_episode_steps for layer in nested(env) if isinstance(layer, TimeLimit)]
        if limits:
            return min(limits)
    if keywords and "max_episode_steps" in keywords:
        return keywords["max_episode_steps"]
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


def renew_world(env: gym.Env) -> None:
    """Before a seeded reset of BipedalWalker: give it the physics world of a new environment.

    It keeps one world for life, in which the order of contacts depends on every body that has been there, and
    the solver takes them in turn: the same seed and actions then end in other last bits.
    """
    walker: Any = env.unwrapped
    if type(walker).__module__ == "gymnasium.envs.box2d.bipedal_walker" and walker.world is not None:
        import Box2D

        walker._destroy()
        old = walker.world
        walker.world = Box2D.b2World(gravity=old.gravity, doSleep=old.allowSleeping)


def make_vector_by_id(env_id: str, num_envs: int, keywords: Mapping[str, Any] | None = None) -> Any:
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
    keywords = dict(keywords or {})
    require_keywords(env_id, keywords, vector=True)

    def make() -> Any:
        make_vec = functools.partial(
            gym.make_vec, env_id, num_envs, vectorization_mode="vector_entry_point", **copy.deepcopy(keywords)
        )
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


def resets_rows_with_seeds(vector: gym.vector.VectorEnv) -> bool:
    """Whether single rows of a vector environment can be reset with seeds, and repeat their episodes: Atari's
    do, from ale-py 0.12 on; earlier ones raise or hang.
    """
    if type(vector).__module__ != "ale_py.vector_env":
        return False
    import ale_py

    return tuple(int(part) for part in ale_py.__version__.split(".")[:2]) >= (0, 12)


class _AnyAction(gym.spaces.MultiDiscrete):
    """The same space without its membership test: an action layout gives valid actions by construction."""

    def contains(self, x: object) -> bool:
        return True


def _trusting(env: gym.vector.VectorEnv) -> Any:
    """Skip the check of every action in a vector version that we made: a fifth of a CartPole step."""
    space = env.action_space
    if type(space) is gym.spaces.MultiDiscrete:
        env.action_space = _AnyAction(space.nvec, dtype=space.dtype, start=space.start)
    return env


def make_envpool(env_id: str, num_envs: int, seed: int, num_threads: int, **keywords: object) -> Any:
    """EnvPool's version of a task; ValueError when EnvPool is missing or does not know the id."""
    try:
        import envpool
    except (ImportError, OSError) as error:  # OSError: its files of data are packages of their own
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
        sizes = {"num_envs": num_envs, "num_threads": num_threads}
        return envpool.make(name, env_type="gymnasium", seed=seed, **sizes, **keywords)


def require_keywords(env: EnvSource, keywords: Mapping[str, object], *, vector: bool = False) -> None:
    """ValueError for a keyword that the constructor of an id, a class or a factory does not take; it lists
    those that it takes. ``vector``: of the id's vector version. Without effect where the signature cannot be
    known.
    """
    if not keywords:
        return
    spec, extra = None, {}
    maker: Any = env
    if isinstance(env, str):
        spec = _explained(env, lambda: gym.spec(env))
        point = spec.vector_entry_point if vector else spec.entry_point
        maker = _explained(env, lambda: load_env_creator(point) if isinstance(point, str) else point)
        extra = {} if vector else {"max_episode_steps": spec.max_episode_steps}
    taken = _taken(maker)
    for name in keywords:
        if taken is None or name in taken or name in extra:
            continue
        near = difflib.get_close_matches(name, [*taken, *extra], n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        defaults = {**taken, **extra, **(spec.kwargs if spec is not None else {})}
        known = ", ".join(f"{key}={defaults[key]!r}" for key in [*taken, *extra]) or "no arguments"
        what = f"the vector version of {env}" if vector else name_of(env)
        other = " The single version may take others: --vector-backend serial." if vector else ""
        raise ValueError(f"env_kwargs: {what} does not take {name!r}.{hint} It takes {known}.{other}")


def _taken(maker: Any) -> dict[str, Any] | None:
    """The arguments that can be given by name, and their defaults; None where some cannot be known.

    ``**kwargs`` of a constructor are looked up in that of the class it inherits from.
    """
    functions = [maker]
    if isinstance(maker, type):
        functions = [
            vars(kind)["__init__"]
            for kind in maker.__mro__
            if "__init__" in vars(kind) and kind is not object
        ]
    found: dict[str, Any] = {}
    for function in functions:
        try:
            parameters = list(inspect.signature(function).parameters.values())
        except (TypeError, ValueError):
            return None
        parameters = parameters[1:] if isinstance(maker, type) else parameters
        for parameter in parameters:
            if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
                found.setdefault(parameter.name, parameter.default)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return {name: Ellipsis if d is inspect.Parameter.empty else d for name, d in found.items()}
    return None if functions else {}


def _explained(env_id: str, make: Callable[[], _T]) -> _T:
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
        near = _did_you_mean(name, gym.registry)
        more = (
            ""
            if near
            else " If a package of its own brings it, install that, and name it: --env-module NAME."
        )
        raise ValueError(f"unknown environment id {env_id!r}.{near}{more}") from error
    except gym.error.Error as error:
        hint = _did_you_mean(env_id, gym.registry)
        raise ValueError(f"environment id {env_id!r} cannot be made: {error}.{hint}") from error


def _missing(env_id: str, spec: EnvSpec | None, error: Exception) -> ValueError:
    """The error for a task whose package is not installed, with the extra to install where we have one."""
    for prefix, (module, extra) in EXTRAS.items():
        if entry_module(spec).startswith(prefix) and importlib.util.find_spec(module) is None:
            return ValueError(f"{env_id} needs {module}. Install it: pip install 'tightrope[{extra}]'.")
    return ValueError(f"{env_id} cannot be made, something it needs is missing: {error}")


def _did_you_mean(name: str, known: Iterable[object]) -> str:
    """`` Did you mean ...?`` over all known ids, whatever their case and version."""
    lowered = {str(key).lower(): str(key) for key in known}
    close = difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.6)
    stem = name.lower().rpartition("-v")[0] or name.lower()
    same = sorted((v for k, v in lowered.items() if k.rpartition("-v")[0] == stem), reverse=True)
    names = list(dict.fromkeys([*same, *(lowered[key] for key in close)]))[:3]
    return f" Did you mean {' or '.join(names)}?" if names else ""


def make_all(
    makers: Sequence[Callable[[], gym.Env]],
    envs: list[gym.Env],
    first: int = 0,
    limit: Limit = contextlib.nullcontext,
    made: Callable[[], None] = lambda: None,
) -> None:
    """Append one environment per maker to ``envs``; ``first``: the number of the first in the run.

    ``limit``: a context, by the name of the call inside, that limits its time. ``made`` is called after each.
    ValueError when a maker returns something else, or the same object twice. EnvironmentFault when the
    environment's own code raises or hangs.
    """
    for maker in makers:
        index = first + len(envs)
        try:
            with limit(f"The constructor of environment {index}"):
                env = maker()
        except RAISED as error:
            if raised_here(error) and not isinstance(error, EnvironmentTimeout):
                raise
            raise fault_while("Making", index, error) from error
        if not isinstance(env, gym.Env):
            raise ValueError(f"the factory returned a {type(env).__name__}; expected a gymnasium.Env.")
        if any(env is other for other in envs):
            raise ValueError(
                f"the factory returned the same object twice ({env}); each call must build a new environment."
            )
        envs.append(env)
        made()


def close_environment(
    env: gym.Env | gym.vector.VectorEnv, index: int, limit: Limit = contextlib.nullcontext
) -> None:
    """Close an environment; EnvironmentFault when its own code raises or hangs. ``limit``: as in
    `make_all`."""
    try:
        with limit(f"close() of environment {index}"):
            env.close()
    except RAISED as error:
        raise fault_while("Closing", index, error) from error

"""The worlds as a Gymnasium vector environment; the only module that knows gymnasium.

    import gymnasium
    import phase_sumo.sim.vector_env  # registers the name

    envs = gymnasium.make_vec("phase_sumo/Highway-v0", num_envs=256, slots=16)

Every agent slot of every world is one sub-environment, row = world * slots + slot, so that one policy drives
all agents of a world (self-play). The agents of a world begin together, when all of them have finished:

- Autoreset is same-step: in the step in which the last agent of a world finishes, its rows already show the
  next scenario. What a finished agent saw last is in ``info["final_obs"]``, what became of it in
  ``info["final_info"]`` (goal, collision, at_fault, road_edge), as gymnasium's own vector environments do.
- An agent that finishes earlier leaves the road, and its slot waits for the others. A world need not fill
  all its slots either. Such rows are padding: the observation is zero, the reward 0, the action is ignored,
  and neither end is reported. ``info["active"]`` says which rows of the observation are agents,
  ``info["valid"]`` which rows of reward and ends come from one. Learn from the valid rows only. Wrappers
  that know neither stay right about returns, but RecordEpisodeStatistics counts waiting as episode length.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from phase_sumo.config import ScenarioConfig, SimConfig, TaskConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.bundle import MapBundle, load_bundle
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.observation import CONTEXT, EGO, PARTNER, ROAD, Observation
from phase_sumo.sim.road_map import POINTS_PER_CELL
from phase_sumo.sim.step import look
from phase_sumo.sim.worlds import Transition, Worlds

NAME = "phase_sumo/Highway-v0"
SLOTS = 16  # agents per world unless said otherwise
CROWD = 192  # agents of the paper's densest regime that fill all slots, as in the training presets

Arrays = dict[str, np.ndarray]
MapSource = MapBundle | str | Path


class HighwayVectorEnv(VectorEnv[Arrays, np.ndarray, np.ndarray]):
    """Worlds of self-driving agents behind Gymnasium's vector interface; see the module on its resets.

    Observations are the scaled features of `sim.observation` (layout and units in its tables) as a Dict:
    ego [E, 24], context [E, 7], partner [E, K, 12], road [E, R, 9] float32, and the masks partner_mask [E, K]
    and road_mask [E, R] int8, 1 for what is really there. Actions are tokens of the jerk x steering-rate
    lattice.

    Args:
        num_envs: E = worlds x slots.
        slots: N, agent slots per world; 16, or all of a smaller ``num_envs``, by default.
        flat: one Box with everything in a row, in the order of `gymnasium.spaces.flatten`, instead of a Dict.
        maps: bundles or ``.npz`` bundle files, from `phase-sumo convert`; at least one.
        rho: curriculum progress in [0, 1]; the attribute may be set at any time.
        training: perturb what is seen of others and road, and start the clocks of the worlds apart.
        task: rules, actions, reward and scenarios; the paper's, with the agent counts scaled to ``slots``,
            by default.

    Attributes:
        environment: the worlds themselves, in torch; new after every seeded reset.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  # gymnasium's

    def __init__(
        self,
        num_envs: int = SLOTS,
        slots: int | None = None,
        maps: Sequence[MapSource] = (),
        flat: bool = False,
        rho: float = 0.0,
        training: bool = False,
        task: TaskConfig | None = None,
        device: torch.device | str = "cpu",
        compiled: bool = False,
    ) -> None:
        slots = min(SLOTS, num_envs) if slots is None else slots
        if slots < 1 or num_envs < 1 or num_envs % slots:
            raise PhaseError(
                f"num_envs {num_envs} is no multiple of slots {slots}: every world has that many agents"
            )
        if not maps:
            raise PhaseError("no maps: pass maps=[...] with bundles or .npz files from `phase-sumo convert`")
        task = task or TaskConfig(scenarios=ScenarioConfig(agent_scale=slots / CROWD))
        self.num_envs, self.rho = num_envs, rho
        self._size = (num_envs // slots, slots)
        self._build = partial(
            Environment,
            [_bundle(source) for source in maps],
            *self._size,
            task,
            device=device,
            training=training,
            compiled=compiled,
        )
        self._environment: Environment | None = None
        space = _observation_space(task.sim)
        self._order = list(space.spaces) if flat else None
        self.single_observation_space = spaces.flatten_space(space) if flat else space
        self.single_action_space = spaces.Discrete(task.actions.count)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def environment(self) -> Environment:
        if self._environment is None:
            raise ResetNeeded("there are no worlds yet: call reset() first")
        return self._environment

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Arrays, dict[str, Any]]:
        """Begin a new scenario in every world; a seed fixes all that follows. There are no options."""
        super().reset(seed=seed)
        if seed is not None or self._environment is None:
            self._environment = self._build(seed=int(self.np_random.integers(2**31)))
        self.environment.rho = self.rho
        self.environment.reset()
        info: dict[str, Any] = {}
        _add(info, "active", _array(self.environment.worlds.controlled))
        return self._seen(), info

    def step(self, actions: np.ndarray) -> tuple[Arrays, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all worlds.

        Args:
            actions: [E] integer tokens.

        Returns:
            observation, reward [E] float64, terminated [E], truncated [E], info.
        """
        environment, action = self.environment, self._tokens(actions)
        environment.rho = self.rho
        before = environment.worlds
        step = environment.step(action)
        info: dict[str, Any] = {}
        _add(info, "active", _array(environment.worlds.controlled))
        _add(info, "valid", _array(step.active))
        finished = _array(step.finished)
        if finished.any():
            outcome: dict[str, Any] = {}
            for name, happened in vars(step.outcome).items():
                _add(outcome, name, _array(happened & step.finished), finished.copy())
            _add(info, "final_info", outcome, finished.copy())
            _add(info, "final_obs", self._last_seen(before, step), finished)
        reward = _array(step.reward).astype(np.float64)
        return self._seen(), reward, _array(step.terminated), _array(step.truncated), info

    def _tokens(self, actions: np.ndarray) -> Tensor:
        """[W, N] int64 on the device."""
        tokens = np.asarray(actions)
        count = int(self.single_action_space.n)  # type: ignore[attr-defined]
        if tokens.shape != (self.num_envs,) or tokens.dtype.kind not in "iu":
            raise PhaseError(f"actions: {tokens.dtype} {tokens.shape} instead of integers ({self.num_envs},)")
        if tokens.min() < 0 or tokens.max() >= count:
            raise PhaseError(f"actions: a token is outside 0..{count - 1}")
        device = self.environment.map_index.device
        return torch.as_tensor(tokens, dtype=torch.long, device=device).view(self._size)

    def _seen(self) -> Any:
        arrays = _arrays(self.environment.observation.map(lambda values: values.flatten(0, 1).clone()))
        padding = ~_array(self.environment.worlds.active)
        for values in arrays.values():
            values[padding] = 0
        return self._shaped(arrays)

    def _shaped(self, arrays: Arrays) -> Any:
        """[E, ...] each, or one [E, F] if they are wanted flat."""
        if self._order is None:
            return arrays
        return np.concatenate(
            [arrays[k].reshape(len(arrays[k]), -1) for k in self._order], 1, dtype=np.float32
        )

    def _last_seen(self, before: Worlds, step: Transition) -> np.ndarray:
        """[E] objects: what each agent that finished saw at its end, without noise; None for the others."""
        env = self.environment
        ending = step.finished.any(-1).nonzero().squeeze(-1)

        def pick(values: Tensor) -> Tensor:
            return values[ending]

        shape, state, task = before.shape.map(pick), step.after.map(pick), before.task.map(pick)
        road, where, active = env.road_map, pick(env.map_index), pick(before.active)
        seen = look(shape, state, task, active, road, where, None, env.task.sim).rows(pick(step.finished))
        rows = self._shaped(_arrays(seen))
        result = np.full(self.num_envs, None, dtype=object)
        for k, row in enumerate(np.flatnonzero(_array(step.finished))):
            result[row] = rows[k] if self._order else {name: values[k] for name, values in rows.items()}
        return result


def _bundle(source: MapSource) -> MapBundle:
    return source if isinstance(source, MapBundle) else load_bundle(source)


def _observation_space(sim: SimConfig) -> spaces.Dict:
    def numbers(*shape: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, shape, np.float32)

    return spaces.Dict(
        {
            "ego": numbers(len(EGO)),
            "context": numbers(len(CONTEXT)),
            "partner": numbers(sim.neighbours, len(PARTNER)),
            "partner_mask": spaces.MultiBinary([sim.neighbours]),
            "road": numbers(POINTS_PER_CELL, len(ROAD)),
            "road_mask": spaces.MultiBinary([POINTS_PER_CELL]),
        }
    )


def _array(values: Tensor) -> np.ndarray:
    """[W, N, ...] as a fresh [E, ...]."""
    return values.flatten(0, 1).cpu().numpy().copy()


def _arrays(seen: Observation) -> Arrays:
    """An observation of [A] agents, masks as the int8 of gymnasium's spaces."""
    arrays = {name: values.cpu().numpy() for name, values in vars(seen).items()}
    return {name: v.view(np.int8) if v.dtype == bool else v for name, v in arrays.items()}


def _add(info: dict[str, Any], key: str, value: Any, present: np.ndarray | None = None) -> None:
    """An entry with gymnasium's mask [E] of the rows that have it; all by default."""
    info[key] = value
    info[f"_{key}"] = np.ones(len(value), dtype=bool) if present is None else present


gymnasium.register(NAME, vector_entry_point=f"{__name__}:{HighwayVectorEnv.__name__}")

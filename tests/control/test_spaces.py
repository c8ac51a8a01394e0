"""Observations to inputs and back, actions from columns to every space, masks in every form."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from tightrope.control.spaces import action_layout, observation_layout, spatial_sides

NESTED = spaces.Dict(
    {
        "b": spaces.Tuple((spaces.Discrete(3, start=2), spaces.Box(-1, 1, (2, 2), np.float64))),
        "a": spaces.MultiDiscrete([2, 3]),
        "c": spaces.MultiBinary(2),
        "eye": spaces.Box(0, 255, (8, 9, 3), np.uint8),
    }
)
OBSERVATION_SPACES = [
    spaces.Box(-1, 1, (4,), np.float32),
    spaces.Box(-1, 1, (), np.float32),
    spaces.Box(-5, 5, (2, 3), np.int32),
    spaces.Box(0, 255, (12, 10), np.uint8),
    spaces.Discrete(4, start=-1),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary((2, 2)),
    NESTED,
]
ACTION_SPACES = [
    spaces.Discrete(4, start=3),
    spaces.Box(-2, 3, (3,), np.float32),
    spaces.Box(-2, 3, (2, 2), np.float64),
    spaces.Box(0, 9, (2,), np.int64),
    spaces.MultiDiscrete([3, 2], start=[1, -1]),
    spaces.MultiBinary((2, 2)),
    spaces.Tuple(
        (spaces.Discrete(2), spaces.Dict({"x": spaces.Box(-1, 1, (1,)), "k": spaces.MultiBinary(3)}))
    ),
]


def batch(space: gym.Space, values: list) -> object:
    empty = gym.vector.utils.create_empty_array(space, len(values))
    return gym.vector.utils.concatenate(space, values, empty)


@pytest.mark.parametrize("space", OBSERVATION_SPACES, ids=str)
def test_a_batch_encodes_as_its_rows_do_one_by_one(space):
    space.seed(3)
    values = [space.sample() for _ in range(5)]
    layout = observation_layout(space)
    whole = layout.encode(batch(space, values), batched=True)
    for i, value in enumerate(values):
        one = layout.encode(value, batched=False)
        assert one.keys() == whole.keys()
        for name in one:
            np.testing.assert_array_equal(one[name][0], whole[name][i])


FLATTENED = [*OBSERVATION_SPACES[:3], *OBSERVATION_SPACES[4:7]]


@pytest.mark.parametrize("space", FLATTENED, ids=str)
def test_flat_agrees_with_gymnasiums_flatten(space):
    space.seed(1)
    value = space.sample()
    flat = observation_layout(space).encode(value, batched=False)["flat"][0]
    np.testing.assert_allclose(flat, gym.spaces.flatten(space, value).astype(np.float32))


def test_nested_columns_follow_the_flatten_order_and_mark_what_may_be_normalised():
    layout = observation_layout(NESTED)
    assert layout.size == 5 + 3 + 4 + 2 and layout.image_shapes == ((8, 9, 3),)
    assert layout.continuous.tolist() == [False] * 8 + [True] * 4 + [False] * 2
    assert layout.one_hot == (slice(0, 2), slice(2, 5), slice(5, 8))
    eye = np.arange(8 * 9 * 3, dtype=np.uint8).reshape(8, 9, 3)
    value = {"a": np.array([1, 2]), "b": (4, np.arange(4.0).reshape(2, 2)), "c": np.array([1, 0]), "eye": eye}
    inputs = layout.encode(value, batched=False)
    assert inputs["flat"][0].tolist() == [0, 1, 0, 0, 1, 0, 0, 1, 0, 1, 2, 3, 1, 0]
    np.testing.assert_array_equal(inputs["image0"][0], eye)
    assert inputs["flat"].dtype == np.float32 and inputs["image0"].dtype == np.uint8


def test_a_plain_batch_is_passed_on_without_a_copy():
    rows = np.ones((3, 4), np.float32)
    assert observation_layout(spaces.Box(-1, 1, (4,))).encode(rows, batched=True)["flat"] is rows


def test_unflatten_gives_the_structure_back_with_leading_axes_kept():
    layout = observation_layout(NESTED)
    NESTED.seed(0)
    values = [NESTED.sample() for _ in range(6)]
    inputs = {k: torch.from_numpy(v) for k, v in layout.encode(batch(NESTED, values), batched=True).items()}
    rolled = {k: v.reshape(2, 3, *v.shape[1:]) for k, v in inputs.items()}
    for given, lead in ((inputs, (6,)), (rolled, (2, 3))):
        out = layout.unflatten(given)
        assert list(out) == ["a", "b", "c", "eye"]
        assert out["b"][1].shape == (*lead, 2, 2) and out["b"][0].shape == (*lead, 3)
        assert out["eye"].dtype == torch.float32
        np.testing.assert_allclose(out["b"][1].reshape(6, 2, 2)[4].numpy(), values[4]["b"][1], rtol=1e-6)
        np.testing.assert_array_equal(out["eye"].reshape(6, 8, 9, 3)[4].numpy(), values[4]["eye"])
    plain = torch.zeros(5, 4)
    assert (
        observation_layout(spaces.Box(-1, 1, (4,))).unflatten({"flat": plain}).data_ptr() == plain.data_ptr()
    )


def test_an_action_mask_in_the_observation_is_no_input():
    parts = {"action_mask": spaces.MultiBinary(3), "x": spaces.Box(-1, 1, (2,))}
    layout = observation_layout(spaces.Dict(parts))
    value = {"action_mask": np.array([1, 0, 1]), "x": np.zeros(2)}
    assert layout.has_mask and layout.size == 2
    assert layout.mask_of(value).tolist() == [1, 0, 1]
    assert list(layout.unflatten({"flat": torch.zeros(1, 2)})) == ["x"]


@pytest.mark.parametrize(
    ("shape", "sides"),
    [((84, 80), (84, 80)), ((84, 80, 3), (84, 80)), ((4, 84, 80), (84, 80)), ((9, 9, 9), (9, 9))],
)
def test_channels_are_found_first_or_last(shape, sides):
    assert spatial_sides(shape) == sides


def test_small_or_non_byte_boxes_are_no_images():
    for space in (spaces.Box(0, 255, (7, 9), np.uint8), spaces.Box(0, 1, (9, 9), np.float32)):
        assert observation_layout(space).image_shapes == ()


UNSUPPORTED = [spaces.Text(3), spaces.Sequence(spaces.Discrete(2)), spaces.Graph(spaces.Box(-1, 1), None)]


@pytest.mark.parametrize("space", UNSUPPORTED, ids=str)
def test_unsupported_spaces_are_named(space):
    space = spaces.Dict({"x": spaces.Box(-1, 1), "odd": space})
    for make in (observation_layout, action_layout):
        with pytest.raises(ValueError, match=r"space.*(Text|Sequence|Graph).*supported are Box"):
            make(space)


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (spaces.Box(-1, 1, (4,)), np.zeros(3), r"shape \(3,\).*\(4,\)"),
        (spaces.Discrete(3), 3, "outside its space"),
        (spaces.Discrete(3), -1, "outside its space"),
        (spaces.Dict({"x": spaces.Discrete(2)}), {"y": 1}, "nothing at"),
        (spaces.Box(-1, 1, (1,)), np.array(["a"]), "not an array of numbers"),
    ],
)
def test_the_error_for_an_observation_outside_its_space_shows_it(space, value, message):
    with pytest.raises(ValueError, match=message):
        observation_layout(space).encode(value, batched=False)


def test_spaces_without_any_number_are_refused():
    with pytest.raises(ValueError, match="holds no numbers"):
        observation_layout(spaces.Dict({}))
    with pytest.raises(ValueError, match="holds no choice"):
        action_layout(spaces.Box(-1, 1, (0,)))


@pytest.mark.parametrize("space", ACTION_SPACES, ids=str)
def test_any_sampled_column_becomes_a_member_of_the_space(space):
    layout = action_layout(space)
    rng = np.random.default_rng(0)
    actions = (rng.standard_normal((64, layout.num_columns)) * 6).astype(np.float32)
    for part in layout.components:
        if part.kind == "categorical":
            actions[:, part.column] = rng.integers(0, part.count, 64)
        elif part.kind == "bernoulli":
            actions[:, part.column : part.column + part.count] = rng.integers(0, 2, (64, part.count))
    for squash in (False, True):
        batched = gym.vector.utils.iterate(
            gym.vector.utils.batch_space(space, 64), layout.to_env(actions, squash)
        )
        for row, one, again in zip(actions, batched, layout.rows(actions, squash), strict=True):
            for value in (one, again, layout.to_env_single(row, squash)):
                assert space.contains(value)
                np.testing.assert_array_equal(
                    gym.spaces.flatten(space, value), gym.spaces.flatten(space, one)
                )


def test_components_lie_side_by_side():
    layout = action_layout(ACTION_SPACES[-1])
    rows = [(c.kind, c.parameter, c.count, c.column, c.mask) for c in layout.components]
    assert rows == [("categorical", 0, 2, 0, 0), ("bernoulli", 2, 3, 1, 2), ("gaussian", 5, 1, 4, -1)]
    assert (layout.num_parameters, layout.num_columns, layout.num_logits) == (6, 5, 5)


def test_starts_bounds_squash_and_rounding():
    assert action_layout(spaces.Discrete(4, start=3)).to_env(np.array([[0], [3]], np.float32)).tolist() == [
        3,
        6,
    ]
    box = action_layout(spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32)))
    assert box.to_env(np.array([[5.0, -1.0]], np.float32)).tolist() == [[2.0, 0.0]]
    squashed = box.to_env(np.array([[0.5, -1.0]], np.float32), squash=True)
    np.testing.assert_allclose(squashed, [[2 * np.tanh(0.5), (1 - np.tanh(1.0)) / 2]], rtol=1e-6)
    whole = action_layout(spaces.Box(0, 9, (3,), np.int64))
    assert whole.to_env(np.array([[1.6, -4.0, 12.0]], np.float32)).tolist() == [[2, 0, 9]]
    action_layout(spaces.Box(-1, 1)).check_squash()
    with pytest.raises(ValueError, match="finite bounds"):
        action_layout(spaces.Box(-np.inf, 1)).check_squash()


def test_environments_get_their_own_array():
    layout = action_layout(spaces.Box(-1, 1, (2,)))
    actions = np.zeros((1, 2), np.float32)
    given = layout.to_env(actions)
    actions[:] = 1
    assert given.tolist() == [[0.0, 0.0]]


def test_masks_in_every_form_mean_the_same():
    many = action_layout(spaces.MultiDiscrete([2, 3]))
    flat = np.array([[1, 0, 1, 1, 0], [0, 1, 0, 0, 1]], bool)
    ragged = np.empty(2, object)
    for i in range(2):
        ragged[i] = (flat[i, :2].astype(np.int8), flat[i, 2:].astype(np.int8))
    for form in (flat, flat.astype(np.int8), flat.tolist(), (flat[:, :2], flat[:, 2:]), ragged):
        np.testing.assert_array_equal(many.flatten_mask(form, 2), flat)
    for form in (flat[0], flat[:1], (flat[0, :2], flat[0, 2:])):
        np.testing.assert_array_equal(many.flatten_mask(form, 1), flat[:1])
    parts = {"a": spaces.Discrete(2), "b": spaces.Box(-1, 1), "c": spaces.MultiBinary(2)}
    nested = action_layout(spaces.Dict(parts))
    given = {"a": np.array([1, 0], np.int8), "b": None, "c": None}
    assert nested.flatten_mask(given, 1).tolist() == [[True, False, True, True]]
    assert nested.flatten_mask(None, 1) is None
    with pytest.raises(ValueError, match=r"action mask is shape \(4,\); expected \(1, 5\)"):
        many.flatten_mask(np.ones(4), 1)


def test_a_row_is_blocked_when_any_categorical_part_is():
    layout = action_layout(spaces.Tuple((spaces.Discrete(2), spaces.Discrete(2), spaces.MultiBinary(2))))
    masks = np.array([[1, 0, 0, 1, 0, 0], [1, 1, 0, 0, 1, 1], [0, 0, 1, 1, 1, 1]], bool)
    assert layout.blocked_rows(masks).tolist() == [1, 2]

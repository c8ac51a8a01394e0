"""Observations to inputs and back, actions from columns to every space, masks in every form."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from tightrope.control.policy.policy import ImageEncoder, Policy
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.actions import action_layout
from tightrope.control.spaces.observations import observation_layout, spatial_sides

NESTED = spaces.Dict(
    {
        "b": spaces.Tuple((spaces.Discrete(3, start=2), spaces.Box(-1, 1, (2, 2), np.float64))),
        "a": spaces.MultiDiscrete([2, 3]),
        "c": spaces.MultiBinary(2),
        "eye": spaces.Box(0, 255, (16, 17, 3), np.uint8),
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
    assert layout.size == 5 + 3 + 4 + 2 and [leaf.space.shape for leaf in layout.images] == [(16, 17, 3)]
    assert layout.continuous.tolist() == [False] * 8 + [True] * 4 + [False] * 2
    assert layout.one_hot == (slice(0, 2), slice(2, 5), slice(5, 8))
    eye = np.resize(np.arange(256, dtype=np.uint8), (16, 17, 3))
    value = {"a": np.array([1, 2]), "b": (4, np.arange(4.0).reshape(2, 2)), "c": np.array([1, 0]), "eye": eye}
    inputs = layout.encode(value, batched=False)
    assert inputs["flat"][0].tolist() == [0, 1, 0, 0, 1, 0, 0, 1, 0, 1, 2, 3, 1, 0]
    np.testing.assert_array_equal(inputs["image0"][0], eye)
    assert inputs["flat"].dtype == np.float64 and inputs["image0"].dtype == np.uint8


def test_a_plain_batch_is_passed_on_without_a_copy():
    rows = np.ones((3, 4))
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
        np.testing.assert_array_equal(out["eye"].reshape(6, 16, 17, 3)[4].numpy(), values[4]["eye"])
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


@pytest.mark.parametrize(
    ("space", "readers"),
    [  # the encoders that read it as an image
        (spaces.Box(0, 255, (84, 84, 3), np.uint8), "auto cnn old"),
        (spaces.Box(0, 255, (1, 16, 17), np.uint8), "auto cnn old"),
        (spaces.Box(0, 255, (1, 15, 17), np.uint8), "cnn old"),  # too small for convolutions to be worth it
        (spaces.Box(0, 255, (1, 8, 9), np.uint8), "cnn old"),
        (spaces.Box(0, 1, (8, 8), np.uint8), "cnn old"),  # a board
        (spaces.Box(0, 255, (5, 5), np.uint8), "cnn"),
        (spaces.Box(0, 255, (3, 5, 5), np.uint8), "cnn"),
        (spaces.Box(0, 255, (7, 7, 3), np.uint8), "cnn"),
        (spaces.Box(0, 1, (9, 9), np.float32), "cnn"),
        (spaces.Box(0, 1, (36, 40, 3), np.float32), "auto cnn"),
        (spaces.Box(0, 1, (36, 40), np.uint8), "auto cnn old"),
        (spaces.Box(-np.inf, np.inf, (64, 64), np.float32), ""),  # nothing to scale by
        (spaces.Box(0, 255, (4, 99), np.uint8), ""),
        (spaces.Box(0, 255, (9, 9, 9, 9), np.uint8), ""),
        (spaces.Box(0, 255, (99,), np.uint8), ""),
    ],
    ids=str,
)
def test_what_convolutions_read(space, readers):
    for encoder in ("auto", "cnn", "mlp", "old"):
        if encoder == "cnn" and not readers:
            with pytest.raises(ValueError, match="encoder is 'cnn', and nothing in the observation space"):
                observation_layout(space, encoder)
        else:
            layout = observation_layout(space, encoder)
            assert bool(layout.images) == (encoder in readers.split()) == (layout.size == 0)


@pytest.mark.parametrize("shape", [(5, 5), (5, 6, 3), (3, 5, 6), (35, 35), (36, 40, 1), (2, 84, 84)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int16, np.bool_])
def test_an_image_of_any_size_and_kind_is_scaled_by_its_bounds(shape, dtype):
    low = np.zeros(shape, dtype) if dtype in (np.uint8, np.bool_) else np.full(shape, -3, dtype)
    high = np.full(shape, {np.uint8: 9, np.bool_: 1}.get(dtype, 7), dtype)
    low.flat[1], high.flat[1] = high.flat[0], high.flat[0]  # a constant; each element has bounds of its own
    space = spaces.Box(low, high, dtype=dtype)
    encoder = ImageEncoder(space, torch.Generator().manual_seed(0))
    layout = observation_layout(space, "cnn")
    ends = [layout.encode(end, batched=False)["image0"] for end in (low, high)]
    seen = []
    encoder.layers.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    for end in ends:
        assert encoder(torch.from_numpy(end)).shape == (1, 512)
    assert not seen[0].any() and sorted(seen[1].unique().tolist()) == [0.0, 1.0] and (seen[1] == 0).sum() == 1
    assert not encoder.state_dict().keys() & {"low", "width"}


def test_bytes_are_divided_by_255():
    space = spaces.Box(0, 255, (9, 9), np.uint8)
    image, seen = torch.randint(0, 256, (2, 9, 9), dtype=torch.uint8), []
    for old in (False, True):
        encoder = ImageEncoder(space, torch.Generator(), old)
        encoder.layers.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
        encoder(image)
        assert torch.equal(seen[-1], image[:, None].float() / 255.0)


def test_large_numbers_keep_their_differences():
    wide = spaces.Dict({"t": spaces.Box(0, 1e12, (1,), np.float64), "n": spaces.Box(0, 2**53, (), np.int64)})
    value = {"t": np.array([1.7e9 + 10]), "n": np.int64(2**53 - 1)}
    for flat in (
        observation_layout(wide).encode(value, batched=False)["flat"],
        observation_layout(wide).encode({k: np.array([v]) for k, v in value.items()}, batched=True)["flat"],
        observation_layout(spaces.Box(0, 1e12, (2,))).encode([[2**53 - 1, 1.7e9 + 10]], batched=True)["flat"],
    ):
        assert flat.tolist() == [[2**53 - 1, 1.7e9 + 10]]


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
    for bounds in ("map", "clip", "squash"):
        layout = action_layout(space, bounds)
        batched = gym.vector.utils.iterate(gym.vector.utils.batch_space(space, 64), layout.to_env(actions))
        for row, one, again in zip(actions, batched, layout.rows(actions), strict=True):
            for value in (one, again, layout.to_env_single(row)):
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
    box = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32))
    actions = np.array([[5.0, -1.0]], np.float32)
    assert action_layout(box, "clip").to_env(actions).tolist() == [[2.0, 0.0]]
    squashed = action_layout(box, "squash").to_env(actions / 10)
    np.testing.assert_allclose(squashed, [[2 * np.tanh(0.5), (1 - np.tanh(0.1)) / 2]], rtol=1e-6)
    whole = action_layout(spaces.Box(0, 9, (3,), np.int64), "clip")
    assert whole.to_env(np.array([[1.6, -4.0, 12.0]], np.float32)).tolist() == [[2, 0, 9]]
    for low, high in ((-np.inf, 1), (np.finfo(np.float32).min, np.finfo(np.float32).max)):
        with pytest.raises(ValueError, match="finite bounds"):
            action_layout(spaces.Box(np.float32(low), np.float32(high), (1,), np.float32), "squash")


@pytest.mark.parametrize(
    ("low", "high", "dtype", "expected"),
    [  # of -3, -1, 0, 0.5, 1, 3
        (100, 200, np.float32, [100, 100, 150, 175, 200, 200]),
        (-1000, 1000, np.float32, [-1000, -1000, 0, 500, 1000, 1000]),
        (-0.25, 0.75, np.float64, [-0.25, -0.25, 0.25, 0.5, 0.75, 0.75]),
        (1e5, 1e5 + 1e-6, np.float64, [1e5, 1e5, 1e5 + 5e-7, 1e5 + 7.5e-7, 1e5 + 1e-6, 1e5 + 1e-6]),
        (0, 10, np.int32, [0, 0, 5, 8, 10, 10]),
        (0, 255, np.uint8, [0, 0, 128, 191, 255, 255]),
        (0, 1, np.bool_, [0, 0, 0, 1, 1, 1]),
        (7, 7, np.float32, [7] * 6),  # a constant
        (-np.inf, np.inf, np.float32, [-3, -1, 0, 0.5, 1, 3]),
        (0, np.inf, np.float32, [0, 0, 0, 0.5, 1, 3]),
        (-1e6, 2, np.float32, [-3, -1, 0, 0.5, 1, 2]),  # a bound that nobody means
    ],
)
def test_box_actions_are_mapped_onto_their_bounds(low, high, dtype, expected):
    other = (-1, 1) if dtype in (np.float32, np.float64) else (0, 1)
    space = spaces.Box(np.array([low, other[0]], dtype), np.array([high, other[1]], dtype), dtype=dtype)
    layout = action_layout(spaces.Dict({"a": space, "b": spaces.Discrete(2)}))
    x = np.array([-3, -1, 0, 0.5, 1, 3], np.float32)
    given = layout.to_env(np.stack([x, x, np.ones_like(x)], axis=1))
    assert given["a"].dtype == dtype and given["b"].tolist() == [1] * 6
    assert given["a"][:, 0].tolist() == [dtype(value) for value in expected]
    if other == (-1, 1):
        assert given["a"][:, 1].tolist() == np.clip(x, -1, 1).tolist()  # each dimension by its own bounds


@pytest.mark.parametrize("bounds", ["map", "squash"])
def test_a_constant_dimension_is_constant_and_its_density_finite(bounds):
    space = spaces.Box(np.array([-2, 5], np.float32), np.array([2, 5], np.float32))
    observations, layout = observation_layout(spaces.Box(-1, 1, (1,))), action_layout(space, bounds)
    policy = Policy(observations, layout, TrainSettings(action_bounds=bounds))
    actions, logp = policy.act({"flat": np.zeros((8, 1), np.float32)}, np.ones((8, 2), np.float32) * 3)
    assert layout.to_env(actions.numpy())[:, 1].tolist() == [5.0] * 8
    assert (
        torch.isfinite(logp).all()
        and torch.isfinite(policy.evaluate({"flat": torch.zeros(8, 1)})[0].entropy()).all()
    )


def test_bounds_of_one_change_no_bit():
    rng = np.random.default_rng(0)
    actions = np.concatenate([rng.standard_normal((99, 3)) * 2, [[-0.0, 0.0, 1.0]]]).astype(np.float32)
    for dtype in (np.float32, np.float64):
        mapped, clipped = (
            action_layout(spaces.Box(-1, 1, (3,), dtype), x).to_env(actions) for x in ("map", "clip")
        )
        assert mapped.tobytes() == clipped.tobytes() == np.clip(actions, -1, 1).astype(dtype).tobytes()


def test_what_is_clipped_or_cannot_be_mapped_is_told():
    low, high = np.array([0, -5, 7, -np.inf], np.float32), np.array([9, 5, 7, np.inf], np.float32)
    space = spaces.Tuple((spaces.Box(low, high), spaces.Discrete(3)))
    actions = np.array([[0.5, 2, 9, 99, 2], [-2, 0, 9, 99, 1]], np.float32)
    assert (
        action_layout(space).clipped_share(actions) == 2 / 4
    )  # constants and what has no bound do not count
    assert action_layout(space, "clip").clipped_share(actions) == 1 / 4
    finite = spaces.Box(low[:3], high[:3])
    assert action_layout(finite, "squash").clipped_share(actions[:, :3]) is None
    assert action_layout(spaces.Discrete(3)).clipped_share(actions[:, :1]) is None
    assert "1 of 4 Box action dimensions have no two finite bounds" in action_layout(space).not_mapped()[0]
    for quiet in (action_layout(finite), action_layout(space, "clip"), action_layout(spaces.Discrete(2))):
        assert quiet.not_mapped() == []


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

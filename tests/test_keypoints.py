import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch

KEYPOINTS = np.array([[[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0]]], np.float32)


def follow(path, keypoints=KEYPOINTS):
    latched, history = jnp.zeros(len(keypoints), jnp.int32), []
    for point in path:
        latched = advance_latch(latched, np.array(point, np.float32).reshape(len(keypoints), 3), keypoints)
        history.append(np.asarray(latched).tolist())
    return history


def test_keypoints_are_reached_in_order_and_stay_reached():
    path = [(0.2, 0, 0), (0.5, 0, 0), (0.04, 0, 0), (0.3, 0, 0), (0.5, 0.01, 0), (0, 0, 0), (0.5, 0.5, 0), (0, 0, 0)]
    # The second keypoint is passed first, which does not count; nor does going back undo anything.
    assert follow(path) == [[0], [0], [1], [1], [2], [2], [3], [3]]


def test_the_radius_is_strict():
    assert follow([(0.0501, 0, 0)]) == [[0]]
    assert follow([(0.0499, 0, 0)]) == [[1]]


def test_coincident_keypoints_are_passed_in_one_look():
    keypoints = np.array([[[0, 0, 0], [0.01, 0, 0], [0.5, 0, 0]]], np.float32)
    assert follow([(0, 0, 0)], keypoints) == [[2]]


def test_arms_latch_apart():
    keypoints = np.concatenate([KEYPOINTS, KEYPOINTS[:, ::-1]])
    assert follow([[(0, 0, 0), (0, 0, 0)], [(0, 0, 0), (0.5, 0.5, 0)]], keypoints) == [[1, 0], [1, 1]]


def test_the_last_keypoint_stays_active():
    for latched, expected in enumerate([0, 1, 2, 2]):
        np.testing.assert_array_equal(active_keypoint(latched, KEYPOINTS[0]), KEYPOINTS[0][expected])
    np.testing.assert_array_equal(active_keypoint(2, KEYPOINTS[0], count=2), KEYPOINTS[0][1])
    chosen = jax.jit(jax.vmap(active_keypoint))(jnp.array([0, 3]), np.concatenate([KEYPOINTS, KEYPOINTS]))
    np.testing.assert_array_equal(chosen, KEYPOINTS[0][[0, 2]])

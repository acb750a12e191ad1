"""The demonstration page: what it says of a turn is what the policy was asked and answered."""

import base64

import cv2
import jax
import numpy as np

from dsvla_jax.evaluation.demo import NUMBERS, SHOWN, describe, draw_tokens
from dsvla_jax.serving.requests import Expected, parse_request
from tests.serving import SIZE, observation, tiny_policy


def test_a_turn_is_described_with_its_prompt_and_probabilities():
    policy = tiny_policy()
    request = parse_request(observation(3), Expected(((SIZE, SIZE),), (1,), policy.config.encoding))
    seen = jax.tree.map(lambda x: np.asarray(x)[None], request.observation)
    assert request.keypoints is not None
    near = request.keypoints[:, 0]
    decision = policy.decide(seen, [request.instruction], near[None])
    step = describe(policy, seen, request.instruction, near, decision)
    assert step.prompt.startswith(request.instruction + " state ")
    assert step.answer == decision.texts[0]
    (arm,) = step.numbers
    assert [name for name, _, _ in arm] == list(NUMBERS)
    assert " ".join(value for _, value, _ in arm) == step.answer
    assert decision.log_probs is not None
    np.testing.assert_allclose([p for _, _, p in arm], np.exp(decision.log_probs[0, 0]), rtol=1e-6)
    for uri in (step.tokens, step.target):
        encoded = base64.b64decode(uri.removeprefix("data:image/png;base64,"))
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape == (SHOWN, SHOWN, 3)


def test_tokens_are_drawn_where_they_are_and_joined_to_their_patch():
    request = parse_request(observation(0), Expected(((SIZE, SIZE),), (1,), tiny_policy().config.encoding))
    black = np.zeros((SIZE, SIZE, 3), np.uint8)
    # On the camera's axis, hence at the middle of the picture; its patch is the first of 2 x 2.
    camera = jax.tree.map(lambda x: np.asarray(x)[0], request.observation.pictures.camera)
    point = camera.world_from_camera[:3] @ np.array([0.0, 0.0, 1.5, 1.0])
    drawn = draw_tokens(black, point[None], np.array([0]), camera, 2)
    middle = SHOWN // 2 + SHOWN // SIZE // 2
    assert drawn[middle, middle].any()
    assert drawn[SHOWN * 3 // 8, SHOWN * 3 // 8].any()
    assert not drawn[SHOWN * 3 // 4, SHOWN * 3 // 4].any()
    assert (drawn[0, SHOWN // 4] == 255).all()

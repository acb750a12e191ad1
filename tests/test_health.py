"""The figures of a run's speed, under a clock that the test turns."""

import time

import pytest

from dsvla_jax.training.health import Clock


@pytest.mark.parametrize("peak", [None, 4e12])
def test_speed_is_what_was_done_over_the_time_that_it_took(monkeypatch, peak: float | None):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    clock = Clock(flops=0.25e12, peak=peak)
    assert clock.read() == {}, "the first step compiles"
    clock.start()
    for _ in range(2):
        with clock.waiting():
            now[0] += 1
        now[0] += 3
        clock.count(examples=16, tokens=100)
    with clock.paused():
        now[0] += 50
    utilisation = {} if peak is None else {"model_flops_utilisation": 0.25}
    assert clock.read() == {
        "seconds_per_step": 4,
        "examples_per_second": 4,
        "tokens_per_second": 25,
        "data_wait_share": 0.25,
        "model_tflops_per_second": 1,
        **utilisation,
    }
    assert clock.read() == {}, "nothing was done since"

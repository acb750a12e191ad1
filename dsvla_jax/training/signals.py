"""Being asked to stop: SIGTERM from a scheduler, Ctrl-C from a person. A run then saves and ends."""

import signal
from types import FrameType

import jax
from jax.experimental import multihost_utils

EXIT_STATUS = {signal.SIGTERM: 75, signal.SIGINT: 130}
"""What a program that saved and stopped ends with. 75 is EX_TEMPFAIL of sysexits.h: the same command goes on."""


class StopRequest:
    """Within the block, the first SIGTERM or Ctrl-C is only noted; the second ends the program at once.

    With several processes, SIGTERM to any of them stops all after the same step: JAX's preemption service carries it.
    """

    def __init__(self) -> None:
        self._received: signal.Signals | None = None
        self._previous: dict[signal.Signals, object] = {}

    def __enter__(self) -> "StopRequest":
        # With several processes SIGTERM belongs to the preemption service.
        own = (signal.SIGTERM, signal.SIGINT) if jax.process_count() == 1 else (signal.SIGINT,)
        self._previous = {number: signal.signal(number, self._note) for number in own}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        del frame
        self._received = signal.Signals(number)
        self._restore()

    def _restore(self) -> None:
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]

    @property
    def noted(self) -> bool:
        """Whether a signal is known of before `after` says so; never with several processes, which have to agree."""
        return self._received is not None and jax.process_count() == 1

    def after(self, step: int) -> signal.Signals | None:
        """The signal that asks to stop after this step, if any. To be asked once a step, by every process."""
        if jax.process_count() > 1 and multihost_utils.reached_preemption_sync_point(step):
            return signal.SIGTERM
        return self._received

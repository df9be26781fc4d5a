"""The computer's clock, watched: quiet where nobody ever kept it, told once somebody no longer does."""

from daemon.cli.lines.clock import clock_sentence
from daemon.host.time_service import ClockState
from daemon.monitoring.time_watch import TimeWatch
from drivers.clock import ManualClock

KEPT = ClockState(True, 2e-4, 5e-3, "chrony")
LEFT = ClockState(False, source="chrony")


def test_a_clock_that_nobody_ever_kept_is_no_loss_and_one_that_was_kept_is() -> None:
    clock, states = ManualClock(), [LEFT, KEPT, LEFT, ClockState(None, error="no answer"), LEFT, KEPT]
    watch = TimeWatch(lambda: states.pop(0), clock)
    assert watch.status() is None
    watch.look()
    assert watch.lost() is None
    clock.advance(60.0)
    watch.look()
    kept_at = clock.now()
    assert watch.lost() is None
    clock.advance(60.0)
    watch.look()
    assert watch.lost() == kept_at
    watch.look()
    assert watch.lost() is None, "what is not known is no loss"
    watch.look()
    assert watch.lost() == kept_at
    watch.look()
    assert watch.lost() is None
    clock.advance(5.0)
    status = watch.status()
    assert status is not None
    assert (status["is_synchronized"], status["offset_s"], status["age_s"]) == (True, 2e-4, 5.0)


def test_sentences_for_people() -> None:
    def sentence(state: ClockState) -> str:
        return clock_sentence(vars(state))

    assert sentence(KEPT) == "synchronised (chrony), 200 us ahead, off by at most 5 ms"
    assert sentence(ClockState(True, -1.5, 2.0, "kernel")) == "synchronised (kernel), 1.5 s behind, off by at most 2 s"
    assert sentence(ClockState(True, None, 0.25, "kernel")) == "synchronised (kernel), off by at most 250 ms"
    assert sentence(LEFT) == "not synchronised with other clocks"
    assert sentence(ClockState(None, error="why")) == "unknown whether it is synchronised (why)"

from lavt.control.lane_watch import BRAKE_AFTER_NS, LANE_CONFIDENCE, STOP_AFTER_NS, LaneWatch

START_NS = 7_000_000_000


def test_without_a_lane_the_watch_brakes_at_500_ms_and_stops_at_2500_ms() -> None:
    """Without a lane for 0.5 s the watch returns "brake", for 2.5 s "stop"."""
    watch = LaneWatch()
    assert watch.check(1.0, START_NS) == "ok"
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS - 1) == "ok"
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS - 1) == "brake"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS) == "stop"


def test_a_lane_restarts_the_timer() -> None:
    """One picture with a lane restarts the timer."""
    watch = LaneWatch()
    watch.check(1.0, START_NS)
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(LANE_CONFIDENCE, START_NS + BRAKE_AFTER_NS + 1) == "ok"
    assert watch.check(0.0, START_NS + 2 * BRAKE_AFTER_NS) == "ok"


def test_the_first_picture_starts_the_timer() -> None:
    """If no lane was ever detected, the timer counts from the first picture."""
    watch = LaneWatch()
    assert watch.check(0.0, START_NS) == "ok"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS) == "stop"

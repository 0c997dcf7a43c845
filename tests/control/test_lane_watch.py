from lavt.control.lane_watch import BRAKE_AFTER_NS, LANE_CONFIDENCE, STOP_AFTER_NS, LaneWatch

START_NS = 7_000_000_000


def test_half_a_second_without_a_lane_brakes_and_two_and_a_half_stop() -> None:
    """Time without a lane is counted from the last picture that had one."""
    watch = LaneWatch()
    assert watch.check(1.0, START_NS) == "ok"
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS - 1) == "ok"
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS - 1) == "brake"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS) == "stop"


def test_a_lane_seen_again_makes_all_well() -> None:
    """One picture with a lane starts the count anew."""
    watch = LaneWatch()
    watch.check(1.0, START_NS)
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(LANE_CONFIDENCE, START_NS + BRAKE_AFTER_NS + 1) == "ok"
    assert watch.check(0.0, START_NS + 2 * BRAKE_AFTER_NS) == "ok"


def test_without_any_lane_time_counts_from_the_first_picture() -> None:
    """A driver that never saw a lane brakes and stops as one that lost it."""
    watch = LaneWatch()
    assert watch.check(0.0, START_NS) == "ok"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS) == "stop"

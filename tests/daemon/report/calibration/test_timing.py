from __future__ import annotations

from calibration.evaluation.latency import Latency
from daemon.report.calibration.timing import timing

PM = "\N{PLUS-MINUS SIGN}"


def latency(milliseconds: float, error_ms: float, fixes: int = 312, motions: int = 24) -> Latency:
    return Latency(milliseconds * 1e-3, error_ms * 1e-3, fixes, motions)


def test_sessions_that_agree_give_one_value_and_one_order() -> None:
    page = timing({"s1": latency(42.4, 5.0), "s2": latency(36.0, 5.0), "s3": "the fixes have no times"})
    for cells in (("s1", f"42 {PM} 5", "312", "24"), ("s2", f"36 {PM} 5", "312", "24")):
        assert all(f">{cell}</td>" in page for cell in cells), cells
    order = f"Station: 39 {PM} 4 ms over 2 sessions; the station is late: add 39 ms to link_delay_s of its [[station]]."
    assert order in page
    assert page.count("[[station]]") == 1
    assert "s3: not known, the fixes have no times." in page


def test_a_precise_session_weighs_more() -> None:
    assert f"Station: 40 {PM} 1 ms over 2 sessions" in timing({"s1": latency(40.0, 1.0), "s2": latency(60.0, 20.0)})


def test_sessions_that_disagree_change_nothing() -> None:
    found = {"s1": latency(160.0, 20.0), "s2": latency(116.0, 12.0), "s3": latency(84.0, 15.0)}
    page = timing(found | {"s4": latency(39.0, 29.0)})
    text = "Station: the sessions disagree (39 to 160 ms): change nothing; a busy computer delays unevenly."
    assert text in page
    assert "[[station]]" not in page


def test_a_late_bus_is_subtracted_and_a_latency_within_its_uncertainty_is_left() -> None:
    page = timing({"s1": latency(-30.0, 0.1)})
    text = f"Station: -30 {PM} 1 ms; the bus is late: subtract 30 ms from link_delay_s of the [[station]]."
    assert text in page
    text = f"Station: 2 {PM} 1 ms, which is not clearly different from zero: change nothing."
    assert text in timing({"s1": latency(2.0, 0.1)})


def test_each_station_has_its_own_order() -> None:
    found = {"s1": latency(160.0, 5.0), "s2": latency(20.0, 5.0)}
    page = timing(found, {"s1": "north", "s2": "south"})
    assert "Station north: 160" in page
    assert "Station south: 20" in page
    assert "disagree" not in page


def test_a_report_without_sessions_has_no_such_section() -> None:
    assert timing({}) == ""

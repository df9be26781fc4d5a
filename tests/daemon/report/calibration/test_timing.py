from __future__ import annotations

from calibration.evaluation.latency import Latency
from daemon.report.calibration.timing import timing


def test_a_report_says_what_to_do_about_a_latency() -> None:
    found = {
        "s1": Latency(seconds=0.0424, standard_error_s=0.005, fixes=312, motions=24),
        "s2": Latency(seconds=-0.03, standard_error_s=0.0001, fixes=40, motions=5),
        "s3": Latency(seconds=0.002, standard_error_s=0.0001, fixes=40, motions=5),
    }
    page = timing(found | {"s4": "the fixes have no times"})
    for cells in (("s1", "42 \N{PLUS-MINUS SIGN} 5", "312", "24"), ("s3", "2 \N{PLUS-MINUS SIGN} 1", "40", "5")):
        assert all(f">{cell}</td>" in page for cell in cells), cells
    assert "In s1 the station is late by 42 ms: add it to link_delay_s of its [[station]]." in page
    assert "In s2 the bus is late by 30 ms: subtract it from link_delay_s of the [[station]]." in page
    assert "In s3" not in page
    assert "s4: not known, the fixes have no times." in page
    assert timing({}) == ""

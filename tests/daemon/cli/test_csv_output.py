"""An observations CSV given back with columns of a command's own."""

import numpy as np

from daemon.cli.offline import with_columns

RAW = b'\xef\xbb\xbfprism, a_deg,note,old_mm,x_mm\r\nr,370,"drill, here",1,2\r\n\r\ns,1e1,,3,4.50\r\n'


def test_the_users_own_text_stays_and_columns_are_put_in_place_or_added() -> None:
    table = with_columns(RAW, {"a_deg": np.array([10.5, 0.1]), "new_mm": np.array([1.0, np.inf])})
    assert table.splitlines() == [
        "prism,a_deg,note,old_mm,x_mm,new_mm",
        'r,10.5,"drill, here",1,2,1.0',
        "s,0.1,,3,4.50,inf",
    ]


def test_what_a_command_wrote_before_and_does_not_now_is_left_out() -> None:
    table = with_columns(RAW, {"x_mm": np.array([0.0, 1.0])}, {"old_mm", "never_mm"})
    assert table.splitlines() == ["prism,a_deg,note,x_mm", 'r,370,"drill, here",0.0', "s,1e1,,1.0"]

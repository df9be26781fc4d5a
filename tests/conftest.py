"""What every test may rely on, whatever started the suite."""

from __future__ import annotations

import signal

# A shell without job control starts what it sends to the background with SIGINT ignored, and so do its children; tests
# that interrupt a process need it heard.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

"""The commands, one file each, with their arguments."""

import signal
import sys
from pathlib import PurePath

_IS_COMMAND = PurePath(sys.argv[0]).name.startswith("xrgs-")
if _IS_COMMAND and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C during the imports ends a command without a traceback; `main` has its own handlers.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

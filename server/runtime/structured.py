"""The package structlog, imported without rich.

structlog imports rich for tracebacks where it is installed. The log does not use these, and rich takes a fifth of the
time in which a server starts.
"""

import sys

_hidden = "rich" not in sys.modules
if _hidden:
    sys.modules["rich"] = None  # type: ignore[assignment]  # the import of such a name fails
try:
    import structlog as structlog
finally:
    if _hidden:
        del sys.modules["rich"]

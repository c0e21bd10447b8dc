"""Compiles modules of the current folder in place, for `scripts/native.py`.

python -m scripts.native_build.compile LEVEL shared/ring.py ...
"""

import os
import sys

from mypyc.build import mypycify
from setuptools import Distribution

extensions = mypycify(sys.argv[2:], opt_level=sys.argv[1], debug_level="0")
if os.name != "nt":
    for extension in extensions:
        # Python's own flags ask for this warning. GCC looks for it three times as long as it compiles, because the
        # generated source is one file of 20 MB.
        extension.extra_compile_args.append("-Wno-misleading-indentation")
command = Distribution({"name": "native", "ext_modules": extensions}).get_command_obj("build_ext")
command.inplace = True
command.ensure_finalized()
command.run()

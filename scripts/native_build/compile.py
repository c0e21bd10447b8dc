"""Compiles modules of the current folder in place, for `scripts/native.py`.

python -m scripts.native_build.compile LEVEL shared/ring.py ...
"""

import sys

from mypyc.build import mypycify
from setuptools import Distribution

extensions = mypycify(sys.argv[2:], opt_level=sys.argv[1], debug_level="0")
command = Distribution({"name": "native", "ext_modules": extensions}).get_command_obj("build_ext")
command.inplace = True
command.ensure_finalized()
command.run()

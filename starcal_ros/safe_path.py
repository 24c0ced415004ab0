# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Python processes that import nothing from the current folder.

``python -m`` puts the current folder first in the path of imports, so in the folder of an
untrusted bag a ``yaml.py`` that lies there would run.  ``-P`` leaves it out, from Python 3.11 on.
"""

import sys  # and nothing else: this runs while the current folder is still in the path

# What -P -m does, for Python 3.10: with -c the first entry is the current folder too.
_RUN = (
    'import sys; del sys.path[0]; import runpy; '
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


def module_command(
    name: str, version: tuple[int, ...] = sys.version_info[:2], interpreter: str = ''
) -> list[str]:
    """Start of a command line that runs a module as ``python -m`` does, by a safe path."""
    interpreter = interpreter or sys.executable
    if version >= (3, 11):
        return [interpreter, '-P', '-m', name]
    return [interpreter, '-c', _RUN, name]


def leave_current_folder() -> None:
    """
    Remove the current folder from the path of imports of a ``python -m starcal_ros...``.

    To be called while Python looks for the module, before anything else is imported.  Other
    programs that import this package keep their path.
    """
    is_looking = sys.argv[:1] == ['-m'] and not getattr(sys.flags, 'safe_path', False)
    if is_looking and any(word.startswith('starcal_ros.') for word in sys.orig_argv):
        del sys.path[0]

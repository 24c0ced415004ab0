# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
One module for each command of the tool.

Its docstring is the help: summary, description, examples (a comment, then the line to type).
`add_arguments` defines its arguments, `run` returns the exit status.  NumPy, SciPy and OpenCV take
a second to import: `run` imports what it needs, so that --help and completion answer at once.
"""

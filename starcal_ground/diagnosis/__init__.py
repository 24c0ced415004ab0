# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Why the images of a set match no star, and the alignment where none is given."""

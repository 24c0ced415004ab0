# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The browser in which tests look at pages."""

import shutil

BROWSER = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), ''
)

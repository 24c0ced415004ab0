# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Prototype of an estimator in which one function of the data decides: see its README."""

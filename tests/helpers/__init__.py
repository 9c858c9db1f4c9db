"""Common parts of tests: scenarios and worlds from plain data, callers of Warp functions, recordings, files, runs."""

import pytest

pytest.register_assert_rewrite("tests.helpers.env_suite")

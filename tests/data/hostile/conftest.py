"""Lets pytest say what was asserted in the module that the tests of hostile files share."""

import pytest

pytest.register_assert_rewrite("hostile_files")

"""JSON columns: quick, and as forgiving as the standard library."""

import enum
import json
import math

import numpy as np
import pytest

from fluoromap_service.store.engine import _from_json, _to_json


class Kind(enum.StrEnum):
    ONE = "one"


@pytest.mark.parametrize(
    "value",
    [
        {"a": [1, 2.5, None, True], "b": {"c": "\u00e4\u4e2d"}},
        [0.1, 1e-300, 1e300, -0.0, 2**53, 2**63],
        {"kind": Kind.ONE},
        {"number": np.float64(0.1)},
        {"text": "half a pair \ud800"},
    ],
)
def test_a_value_comes_back_as_from_the_standard_library(value):
    assert _from_json(_to_json(value)) == json.loads(json.dumps(value))


def test_numbers_that_are_none_are_read():
    assert math.isnan(_from_json("[NaN]")[0])

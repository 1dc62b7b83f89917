"""C written by hand: batches, helpers from CasADi, the cache."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from codegen.build import load_or_compile
from codegen.cache import Cache
from codegen.errors import CodegenError
from codegen.function import Signature
from codegen.source import handwritten_source

TEXT = """
int twice_norm(const double** arg, double** res, long long* iw, double* w, int mem) {
  double length;
  const double* inner_arg[1] = {arg[0]};
  double* inner_res[1] = {&length};
  norm(inner_arg, inner_res, iw, w, mem);
  res[0][0] = 2.0 * length;
  return 0;
}
int twice_norm_work(long long* arg, long long* res, long long* iw, long long* w) {
  *arg = 1; *res = 1; *iw = 0; *w = 0;
  return 0;
}
void twice_norm_incref(void) {}
int twice_norm_checkout(void) { return 0; }
void twice_norm_release(int mem) { (void)mem; }
"""


def source(text: str = TEXT) -> tuple[Signature, str]:
    x = ca.SX.sym("x", 3)
    norm = ca.Function("norm", [x], [ca.norm_2(x)])
    signature = Signature("twice_norm", ("x",), ("y",), ((3,),), ((),))
    return signature, handwritten_source(signature, text, [norm])


def refuse() -> tuple[Signature, str]:
    raise AssertionError("made again")


def test_a_batch_calls_its_helper_and_is_found_again(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    function = load_or_compile("key", source, cache)
    x = np.random.default_rng(1).normal(size=(50, 3))
    expected = 2.0 * np.linalg.norm(x, axis=1)
    np.testing.assert_allclose(function.batch(x, threads=2)["y"], expected, rtol=1e-15)
    again = load_or_compile("key", refuse, cache)
    np.testing.assert_array_equal(again(x[0])["y"], function(x[0])["y"])


def test_text_that_is_no_c_is_told(tmp_path: Path) -> None:
    with pytest.raises(CodegenError, match="twice_norm"):
        load_or_compile("key", lambda: source("no C at all"), Cache(tmp_path))

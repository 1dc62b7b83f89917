#include "native.hpp"

namespace {

// What the name of the module for this processor ends with, see `native.py`.
std::string level() {
#ifdef __x86_64__
  const bool wide = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
  const bool widest = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                      __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512vl");
  if (wide) return widest ? "_v4" : "_v3";
#endif
  return "";
}

}  // namespace

PYBIND11_MODULE(MODULE_NAME, module) {
  module.doc() = "The polish's programs: their rows, and how they are solved.";
  module.attr("LEVEL") = level();
  module.def("dense", &dense, py::arg("program"), py::arg("barrier"), py::arg("wanted"),
             py::arg("patience"), py::arg("tolerance"), py::arg("feasible"));
  module.def("quadratic", &quadratic, py::arg("program"), py::arg("tolerance"));
  offer_rows(module);
}

#include <pybind11/pybind11.h>

#include "bridge.hpp"

namespace py = pybind11;

PYBIND11_MODULE(_pinocchio_casadi, module) {
  module.doc() = "Pinocchio's algorithms over casadi::SX, handed over as serialised functions.";
  module.attr("PINOCCHIO_VERSION") = bridge::pinocchio_version();
  module.attr("CASADI_VERSION") = bridge::casadi_version();
  module.def("frame_kinematics", &bridge::frame_kinematics, py::arg("model_text"),
             py::arg("frame"));
  module.def("frame_drift", &bridge::frame_drift, py::arg("model_text"), py::arg("frame"));
  module.def("joint_placements", &bridge::joint_placements, py::arg("model_text"));
  module.def("inverse_dynamics", &bridge::inverse_dynamics, py::arg("model_text"));
}

// The extension module: each function turns a serialised Pinocchio model into a serialised
// casadi::Function over casadi::SX.
#include <cstddef>
#include <stdexcept>
#include <string>
#include <vector>

#include <pybind11/pybind11.h>

#include "pinocchio/autodiff/casadi.hpp"

#include "pinocchio/algorithm/frames.hpp"
#include "pinocchio/algorithm/jacobian.hpp"
#include "pinocchio/algorithm/kinematics.hpp"
#include "pinocchio/algorithm/rnea.hpp"
#include "pinocchio/config.hpp"
#include "pinocchio/multibody.hpp"
#include "pinocchio/serialization.hpp"
#include <casadi/config.h>

namespace py = pybind11;

using SX = casadi::SX;
using Model = pinocchio::ModelTpl<SX>;
using Data = pinocchio::DataTpl<SX>;
using Vector = Eigen::Matrix<SX, Eigen::Dynamic, 1>;

namespace {

// Reads the text written by `pinocchio.Model.saveToString()`.
// Throws std::invalid_argument where the text is no such model.
Model read_model(const std::string& model_text) {
  pinocchio::ModelTpl<double> model;
  try {
    model.loadFromString(model_text);
  } catch (const std::exception& error) {
    throw std::invalid_argument(std::string("not a serialised Pinocchio model: ") + error.what());
  }
  return model.cast<SX>();
}

// Throws std::out_of_range where the model has no such frame.
void require_frame(const Model& model, std::size_t frame) {
  if (frame >= static_cast<std::size_t>(model.nframes))
    throw std::out_of_range("frame " + std::to_string(frame) + " of a model with " +
                            std::to_string(model.nframes) + " frames");
}

Vector to_eigen(const SX& column) {
  Vector result(column.size1());
  for (casadi_int i = 0; i < column.size1(); ++i) result(i) = column(i);
  return result;
}

template <typename Derived>
SX to_casadi(const Eigen::MatrixBase<Derived>& matrix) {
  SX result(static_cast<casadi_int>(matrix.rows()), static_cast<casadi_int>(matrix.cols()));
  result = SX::densify(result);
  for (Eigen::Index j = 0; j < matrix.cols(); ++j)
    for (Eigen::Index i = 0; i < matrix.rows(); ++i) result(i, j) = matrix(i, j);
  return result;
}

std::string frame_kinematics(const std::string& model_text, std::size_t frame) {
  const Model model = read_model(model_text);
  require_frame(model, frame);
  Data data(model);

  const SX q = SX::sym("q", model.nq);
  pinocchio::computeJointJacobians(model, data, to_eigen(q));
  const auto& placement = pinocchio::updateFramePlacement(model, data, frame);
  Data::Matrix6x jacobian = Data::Matrix6x::Zero(6, model.nv);
  pinocchio::getFrameJacobian(model, data, frame, pinocchio::LOCAL_WORLD_ALIGNED, jacobian);

  return casadi::Function("frame_kinematics", {q},
                          {to_casadi(placement.rotation()), to_casadi(placement.translation()),
                           to_casadi(jacobian)},
                          {"q"}, {"rotation", "position", "jacobian"})
      .serialize();
}

std::string frame_drift(const std::string& model_text, std::size_t frame) {
  const Model model = read_model(model_text);
  require_frame(model, frame);
  Data data(model);

  const SX q = SX::sym("q", model.nq);
  const SX v = SX::sym("v", model.nv);
  const Vector zero = Vector::Zero(model.nv);
  pinocchio::forwardKinematics(model, data, to_eigen(q), to_eigen(v), zero);
  pinocchio::updateFramePlacement(model, data, frame);
  const auto acceleration = pinocchio::getFrameClassicalAcceleration(
      model, data, frame, pinocchio::LOCAL_WORLD_ALIGNED);

  return casadi::Function("frame_drift", {q, v}, {to_casadi(acceleration.toVector())},
                          {"q", "v"}, {"drift"})
      .serialize();
}

std::string joint_placements(const std::string& model_text) {
  const Model model = read_model(model_text);
  Data data(model);

  const SX q = SX::sym("q", model.nq);
  pinocchio::forwardKinematics(model, data, to_eigen(q));
  std::vector<SX> rotations;
  std::vector<SX> positions;
  for (pinocchio::JointIndex joint = 1; joint < data.oMi.size(); ++joint) {
    rotations.push_back(to_casadi(data.oMi[joint].rotation()));
    positions.push_back(to_casadi(data.oMi[joint].translation()));
  }

  return casadi::Function("joint_placements", {q},
                          {SX::horzcat(rotations), SX::horzcat(positions)}, {"q"},
                          {"rotations", "positions"})
      .serialize();
}

std::string inverse_dynamics(const std::string& model_text) {
  const Model model = read_model(model_text);
  Data data(model);

  const SX q = SX::sym("q", model.nq);
  const SX v = SX::sym("v", model.nv);
  const SX a = SX::sym("a", model.nv);
  const Vector torque = pinocchio::rnea(model, data, to_eigen(q), to_eigen(v), to_eigen(a));

  return casadi::Function("inverse_dynamics", {q, v, a}, {to_casadi(torque)}, {"q", "v", "a"},
                          {"torque"})
      .serialize();
}

}  // namespace

PYBIND11_MODULE(_pinocchio_casadi, module) {
  module.doc() = "Pinocchio's algorithms over casadi::SX, handed over as serialised functions.";
  module.attr("PINOCCHIO_VERSION") = PINOCCHIO_VERSION;
  module.attr("CASADI_VERSION") = CASADI_VERSION_STRING;
  module.def("frame_kinematics", &frame_kinematics, py::arg("model_text"), py::arg("frame"));
  module.def("frame_drift", &frame_drift, py::arg("model_text"), py::arg("frame"));
  module.def("joint_placements", &joint_placements, py::arg("model_text"));
  module.def("inverse_dynamics", &inverse_dynamics, py::arg("model_text"));
}

#include "bridge.hpp"
#include "symbolic_model.hpp"

#include "pinocchio/algorithm/frames.hpp"
#include "pinocchio/algorithm/jacobian.hpp"
#include "pinocchio/algorithm/kinematics.hpp"

namespace bridge {

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

}  // namespace bridge

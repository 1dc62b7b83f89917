// What the extension module offers: each function turns a serialised Pinocchio model into a
// serialised casadi::Function over casadi::SX. Kept free of heavy headers, so that the binding
// code and the algorithms compile in parallel.
#pragma once

#include <cstddef>
#include <string>

namespace bridge {

std::string frame_kinematics(const std::string& model_text, std::size_t frame);
std::string frame_drift(const std::string& model_text, std::size_t frame);
std::string joint_placements(const std::string& model_text);
std::string inverse_dynamics(const std::string& model_text);

const char* pinocchio_version();
const char* casadi_version();

}  // namespace bridge

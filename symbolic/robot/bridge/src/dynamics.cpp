#include "bridge.hpp"
#include "symbolic_model.hpp"

#include "pinocchio/algorithm/rnea.hpp"
#include <casadi/config.h>

#include "pinocchio/config.hpp"

namespace bridge {

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

const char* pinocchio_version() { return PINOCCHIO_VERSION; }

const char* casadi_version() { return CASADI_VERSION_STRING; }

}  // namespace bridge

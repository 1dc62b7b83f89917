#include "symbolic_model.hpp"

#include <stdexcept>

#include "pinocchio/serialization.hpp"

namespace bridge {

Model read_model(const std::string& model_text) {
  pinocchio::ModelTpl<double> model;
  try {
    model.loadFromString(model_text);
  } catch (const std::exception& error) {
    throw std::invalid_argument(std::string("not a serialised Pinocchio model: ") + error.what());
  }
  return model.cast<SX>();
}

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

}  // namespace bridge

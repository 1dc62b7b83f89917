// The symbolic model and the helpers that the algorithm files share.
#pragma once

#include <cstddef>
#include <string>

#include "pinocchio/autodiff/casadi.hpp"

#include "pinocchio/multibody.hpp"

namespace bridge {

using SX = casadi::SX;
using Model = pinocchio::ModelTpl<SX>;
using Data = pinocchio::DataTpl<SX>;
using Vector = Eigen::Matrix<SX, Eigen::Dynamic, 1>;

// Reads the text written by `pinocchio.Model.saveToString()`.
// Throws std::invalid_argument where the text is no such model.
Model read_model(const std::string& model_text);

// Throws std::out_of_range where the model has no such frame.
void require_frame(const Model& model, std::size_t frame);

Vector to_eigen(const SX& column);

template <typename Derived>
SX to_casadi(const Eigen::MatrixBase<Derived>& matrix) {
  SX result(static_cast<casadi_int>(matrix.rows()), static_cast<casadi_int>(matrix.cols()));
  result = SX::densify(result);
  for (Eigen::Index j = 0; j < matrix.cols(); ++j)
    for (Eigen::Index i = 0; i < matrix.rows(); ++i) result(i, j) = matrix(i, j);
  return result;
}

}  // namespace bridge

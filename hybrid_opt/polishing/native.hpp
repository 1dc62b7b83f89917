// What all C++ of the polish begins with.

#pragma once

#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

namespace py = pybind11;

using Eigen::Index;
using Array = Eigen::ArrayXd;
using Vector = Eigen::VectorXd;
using Indices = Eigen::Matrix<Index, Eigen::Dynamic, 1>;
using Matrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// The largest absolute value, 0 of none; NaN wins.
template <class Values>
double most(const Values &values) {
  return values.size() ? values.array().abs().template maxCoeff<Eigen::PropagateNaN>() : 0.0;
}

// Adds the lower half of left^T right.
inline void add_products(Matrix &to, const Matrix &left, const Matrix &right) {
  to.triangularView<Eigen::Lower>() += left.transpose() * right;
}

// What `rows.cpp` offers to Python beside the rows.
py::tuple dense(const py::object &program, double barrier, int wanted, int patience, double tolerance,
                double feasible);

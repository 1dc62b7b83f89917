// Newton's method on the joints of an arm whose last joint has to reach given poses.
//
// Formulas and names as in `kinematics.py`. Poses are (4, 4) in the world, lengths in m, angles in rad.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

namespace py = pybind11;

namespace {

using Numbers = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Vector3 = Eigen::Vector3d;
using Matrix3 = Eigen::Matrix3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Columns = Eigen::Matrix<double, 6, Eigen::Dynamic>;
using Joints = Eigen::VectorXd;
using Row = Eigen::Map<const Joints>;

// Added to the diagonal of matrices of least squares, for joints that do not move the pose.
constexpr double SQUARES = 1e-12, LEAST_NORM = 1e-9;

// How following a path ended; a joint beyond its limits is `AT_LIMIT` plus its index.
enum End { ARRIVED, NO_REACH, SINGULAR, AT_LIMIT };

struct Pose {
  Matrix3 R;
  Vector3 p;

  explicit Pose(const double *entries) {
    const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> T(entries);
    R = T.topLeftCorner<3, 3>(), p = T.topRightCorner<3, 1>();
  }

  void write(double *entries) const {
    Eigen::Map<Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> T(entries);
    T.setIdentity();
    T.topLeftCorner<3, 3>() = R, T.topRightCorner<3, 1>() = p;
  }
};

struct Joint {
  Pose origin;
  Vector3 axis;
  Matrix3 K, K_squared;  // the axis' cross product
  bool turning;
};

// Where a posture puts the last joint, its Jacobian, and what is missing to a wanted pose.
struct State {
  explicit State(const Pose &root) : last(root) {}

  Pose last;
  Columns J;
  Vector6 error;
  double residual = 0.0;
};

Numbers empty(std::vector<py::ssize_t> shape) { return Numbers(std::move(shape)); }

const double *checked(const Numbers &array, py::ssize_t size) {
  if (array.size() != size) throw std::invalid_argument("arrays of postures and poses differ in length");
  return array.data();
}

class Arm {
 public:
  Arm(const Numbers &root, const Numbers &origins, const Numbers &axes, const std::vector<bool> &turning,
      const std::vector<int> &following)
      : root_(checked(root, 16)), following_(following) {
    const py::ssize_t n = static_cast<py::ssize_t>(turning.size());
    const double *origin = checked(origins, 16 * n), *axis = checked(axes, 3 * n);
    for (py::ssize_t k = 0; k < n; ++k) {
      Joint joint{Pose(origin + 16 * k), Vector3(axis + 3 * k), {}, {}, turning[k]};
      const Vector3 &a = joint.axis;
      joint.K << 0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0;
      joint.K_squared = joint.K * joint.K;
      joints_.push_back(joint);
    }
    if (following.size() != 6) throw std::invalid_argument("an arm follows with six joints");
  }

  // (n, 4, 4) poses of the last joint and (n, 6, joints) Jacobians of postures (n, joints).
  py::tuple places(const Numbers &q) const {
    const py::ssize_t n = rows_of(q), m = joints();
    Numbers poses = empty({n, 4, 4}), jacobians = empty({n, 6, m});
    State state = fresh();
    for (py::ssize_t k = 0; k < n; ++k) {
      place(Row(q.data() + k * m, m), state);
      state.last.write(poses.mutable_data() + 16 * k);
      using Rows = Eigen::Matrix<double, 6, Eigen::Dynamic, Eigen::RowMajor>;
      Eigen::Map<Rows>(jacobians.mutable_data() + 6 * m * k, 6, m) = state.J;
    }
    return py::make_tuple(poses, jacobians);
  }

  // `ArmKinematics.solve`: postures (n, joints), residuals (n,), determinants (n,).
  py::tuple solve(const Numbers &q, const Numbers &targets, int steps, double damping, double reached,
                  double limit) const {
    return moved(q, targets, [&](Joints &at, const Pose &target, State &state) {
      for (int step = 0;; ++step) {
        place(at, state), compare(target, state);
        if (step == steps || state.residual < reached) return;
        const Matrix6 J = of_following(state.J);
        Matrix6 squares = J.transpose() * J;
        const double damped = damping * std::pow(std::min(state.residual, 1.0), 2);
        squares.diagonal().array() += damped + SQUARES;
        Vector6 move = squares.ldlt().solve(J.transpose() * state.error);
        move *= limit / std::max(move.cwiseAbs().maxCoeff(), limit);
        add(move, at);
      }
    });
  }

  // `ArmKinematics.track`, with (joints,) moving 1 or 0 and the first step's drift (joints,) to the
  // middle between (joints,) lower and upper limits. Joints that would leave their limits do not move.
  py::tuple track(const Numbers &q, const Numbers &targets, int steps, const Numbers &moving,
                  const Numbers &lower, const Numbers &upper, double share) const {
    const py::ssize_t m = joints();
    const Row low(checked(lower, m), m), high(checked(upper, m), m), all(checked(moving, m), m);
    const Joints centre = (low + high) / 2.0;
    return moved(q, targets, [&](Joints &at, const Pose &target, State &state) {
      for (int step = 0;; ++step) {
        place(at, state), compare(target, state);
        if (step == steps) return;
        Joints free = all, move;
        for (bool again = true; again;) {
          const Columns own = state.J * free.asDiagonal();
          Matrix6 squares = own * own.transpose();
          squares.diagonal().array() += LEAST_NORM;
          Joints drift = Joints::Zero(m);
          if (step == 0) drift = share * (centre - at).cwiseProduct(free);
          move = drift + own.transpose() * squares.ldlt().solve(state.error - own * drift);
          again = false;
          for (py::ssize_t i = 0; i < m && free.sum() > 6.0; ++i)
            if ((move[i] > 0.0 && at[i] + move[i] > high[i]) || (move[i] < 0.0 && at[i] + move[i] < low[i]))
              free[i] = 0.0, again = true;
        }
        at += move;
      }
    });
  }

  // Postures (k, joints) along poses (n, 4, 4), from a posture near the first one, by full Newton steps;
  // k < n before the first pose that cannot be followed, and why. `redundant` are indices of joints,
  // and (n, redundant) `positions` theirs along the path.
  py::tuple follow(const Numbers &q, const Numbers &targets, const std::vector<int> &redundant,
                   const Numbers &positions, int steps, double reached, double jump, const Numbers &lower,
                   const Numbers &upper, double side, double least) const {
    const py::ssize_t m = joints(), n = targets.shape(0), r = static_cast<py::ssize_t>(redundant.size());
    const double *target = checked(targets, 16 * n), *given = checked(positions, r * n);
    const Row low(checked(lower, m), m), high(checked(upper, m), m);
    Joints at = Row(checked(q, m), m);
    std::vector<double> found;
    State state = fresh();
    int end = ARRIVED;
    for (py::ssize_t k = 0; k < n && end == ARRIVED; ++k) {
      const Joints before = at;
      for (py::ssize_t i = 0; i < r; ++i) at[redundant[i]] = given[k * r + i];
      end = closed(Pose(target + 16 * k), steps, reached, jump, at, state);
      if (end == ARRIVED && (at - before).cwiseAbs().maxCoeff() > jump) end = NO_REACH;
      for (int i = 0; i < m && end == ARRIVED; ++i)
        if (!(at[i] >= low[i] && at[i] <= high[i])) end = AT_LIMIT + i;
      if (end == ARRIVED && side * of_following(state.J).determinant() < least) end = SINGULAR;
      if (end == ARRIVED) found.insert(found.end(), at.data(), at.data() + m);
    }
    Numbers path = empty({static_cast<py::ssize_t>(found.size()) / m, m});
    std::copy(found.begin(), found.end(), path.mutable_data());
    return py::make_tuple(path, end);
  }

 private:
  py::ssize_t joints() const { return static_cast<py::ssize_t>(joints_.size()); }

  py::ssize_t rows_of(const Numbers &q) const {
    checked(q, q.shape(0) * joints());
    return q.shape(0);
  }

  State fresh() const {
    State state(root_);
    state.J.resize(6, joints());
    return state;
  }

  Matrix6 of_following(const Columns &J) const {
    Matrix6 found;
    for (int k = 0; k < 6; ++k) found.col(k) = J.col(following_[k]);
    return found;
  }

  void add(const Vector6 &move, Joints &at) const {
    for (int k = 0; k < 6; ++k) at[following_[k]] += move[k];
  }

  template <class Posture>
  void place(const Posture &q, State &state) const {
    Pose &T = state.last;
    T = root_;
    for (size_t k = 0; k < joints_.size(); ++k) {
      const Joint &joint = joints_[k];
      T.p += T.R * joint.origin.p;
      T.R = (T.R * joint.origin.R).eval();
      const Vector3 axis = T.R * joint.axis;
      // Until the last joint is known the upper half holds the joint's place.
      state.J.col(k) << T.p, axis;
      if (joint.turning)
        T.R = (T.R * (Matrix3::Identity() + std::sin(q[k]) * joint.K +
                      (1.0 - std::cos(q[k])) * joint.K_squared)).eval();
      else
        T.p += q[k] * axis;
    }
    for (size_t k = 0; k < joints_.size(); ++k) {
      const Vector3 from = state.J.col(k).head<3>(), axis = state.J.col(k).tail<3>();
      if (joints_[k].turning)
        state.J.col(k).head<3>() = axis.cross(T.p - from);
      else
        state.J.col(k) << axis, Vector3::Zero();
    }
  }

  static void compare(const Pose &target, State &state) {
    const Matrix3 dR = target.R * state.last.R.transpose();
    const Vector3 dp = target.p - state.last.p;
    const Vector3 twice(dR(2, 1) - dR(1, 2), dR(0, 2) - dR(2, 0), dR(1, 0) - dR(0, 1));
    state.error << dp, twice / 2.0;
    state.residual = std::sqrt(dp.squaredNorm() + (target.R - state.last.R).squaredNorm() / 2.0);
  }

  template <class Search>
  py::tuple moved(const Numbers &q, const Numbers &targets, const Search &search) const {
    const py::ssize_t n = rows_of(q), m = joints();
    const double *target = checked(targets, 16 * n);
    Numbers found = empty({n, m}), residual = empty({n}), determinant = empty({n});
    State state = fresh();
    for (py::ssize_t k = 0; k < n; ++k) {
      Joints at = Row(q.data() + k * m, m);
      search(at, Pose(target + 16 * k), state);
      std::copy(at.data(), at.data() + m, found.mutable_data() + k * m);
      residual.mutable_data()[k] = state.residual;
      determinant.mutable_data()[k] = of_following(state.J).determinant();
    }
    return py::make_tuple(found, residual, determinant);
  }

  int closed(const Pose &target, int steps, double reached, double jump, Joints &at, State &state) const {
    for (int step = 0; step < steps; ++step) {
      place(at, state), compare(target, state);
      if (state.residual < reached) return ARRIVED;
      const Vector6 move = of_following(state.J).partialPivLu().solve(state.error);
      if (!move.allFinite()) return SINGULAR;
      if (move.cwiseAbs().maxCoeff() > jump) return NO_REACH;
      add(move, at);
    }
    return NO_REACH;
  }

  Pose root_;
  std::vector<Joint> joints_;
  std::vector<int> following_;
};

}  // namespace

PYBIND11_MODULE(_newton, module) {
  py::class_<Arm>(module, "Arm")
      .def(py::init<const Numbers &, const Numbers &, const Numbers &, const std::vector<bool> &,
                    const std::vector<int> &>())
      .def("places", &Arm::places)
      .def("solve", &Arm::solve)
      .def("track", &Arm::track)
      .def("follow", &Arm::follow);
  module.attr("SINGULAR") = static_cast<int>(SINGULAR);
  module.attr("AT_LIMIT") = static_cast<int>(AT_LIMIT);
}

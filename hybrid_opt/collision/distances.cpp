// Distances of convex pieces, and proofs that they are apart or intersect.
//
// Coal's GJK and EPA propose, the shapes themselves prove. Apart: the gap between the supports of both
// pieces along the proposed direction, which never exceeds their distance. Intersecting: a ball about
// the origin inside points of their Minkowski difference. What neither proves stays open.

#include <coal/config.hh>
#include <coal/narrowphase/gjk.h>
#include <coal/shape/convex.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

namespace py = pybind11;

namespace {

using Vector = coal::Vec3s;
using Rotation = coal::Matrix3s;
using Numbers = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Indices = py::array_t<std::int64_t, py::array::c_style | py::array::forcecast>;
using coal::details::EPA;
using coal::details::GJK;

constexpr double INFINITE = std::numeric_limits<double>::infinity();

// Relative and absolute accuracy of a distance [m], and steps after which its bounds stay as they are.
constexpr double GJK_TOLERANCE = 1e-9;
constexpr size_t GJK_STEPS = 128;

// Bounds farther apart than this are not those of nearest points [m].
constexpr double LOOSE = 1e-7;

// Accuracy of a depth [m], far below the margin that a proof leaves to FCL.
constexpr double EPA_TOLERANCE = 1e-6;
constexpr size_t EPA_STEPS = 64;

enum Kind { BOX, CYLINDER, SPHERE, CAPSULE, HULL };
enum Verdict { INTERSECTING = -1, OPEN = 0, APART = 1 };

struct Pose {
  Rotation R;
  Vector p;
};

constexpr int WIDTH = 4;  // corners of a hull side by side: x of all, y of all, z of all

// Largest u.x over corners, `WIDTH` side by side.
double farthest_corner(const double *corners, size_t size, double u, double v, double w) {
  double most[WIDTH] = {-INFINITE, -INFINITE, -INFINITE, -INFINITE};
  for (size_t k = 0; k < size; k += 3 * WIDTH) {
    const double *x = corners + k, *y = x + WIDTH, *z = y + WIDTH;
    for (int i = 0; i < WIDTH; ++i) {
      const double along = u * x[i] + v * y[i] + w * z[i];
      most[i] = along > most[i] ? along : most[i];
    }
  }
  return std::max(std::max(most[0], most[1]), std::max(most[2], most[3]));
}

// A convex shape in its own frame.
class Shape {
 public:
  // size: half edges; radius and half length; radius. corners: (count, 3) of a hull.
  Shape(Kind kind, const Vector &size, const double *corners, std::int64_t count)
      : kind_(kind), size_(size) {
    switch (kind) {
      case BOX:
        coal_ = std::make_unique<coal::Box>(2.0 * size);
        radius = size.norm();
        break;
      case CYLINDER:
        coal_ = std::make_unique<coal::Cylinder>(size[0], 2.0 * size[1]);
        radius = std::hypot(size[0], size[1]);
        break;
      case SPHERE:
        coal_ = std::make_unique<coal::Sphere>(size[0]);
        radius = size[0];
        break;
      case CAPSULE:
        coal_ = std::make_unique<coal::Capsule>(size[0], 2.0 * size[1]);
        radius = size[0] + size[1];
        break;
      case HULL:
        set_hull(corners, count);
    }
  }

  // Largest u.x over the shape.
  double support(const Vector &u) const {
    switch (kind_) {
      case BOX:
        return u.cwiseAbs().dot(size_);
      case CYLINDER:
        return std::abs(u[2]) * size_[1] + std::hypot(u[0], u[1]) * size_[0];
      case SPHERE:
        return u.norm() * size_[0];
      case CAPSULE:
        return std::abs(u[2]) * size_[1] + u.norm() * size_[0];
      case HULL:
        break;
    }
    return farthest_corner(corners_.data(), corners_.size(), u[0], u[1], u[2]);
  }

  const coal::ShapeBase *coal() const { return coal_.get(); }

  Vector centre = Vector::Zero();  // of a ball that holds the shape
  double radius;

 private:
  void set_hull(const double *corners, std::int64_t count) {
    std::vector<Vector> points;
    for (std::int64_t k = 0; k < count; ++k) points.emplace_back(corners + 3 * k);
    auto own = std::make_shared<std::vector<Vector>>(points);
    coal_.reset(coal::ConvexBase::convexHull(own, static_cast<unsigned>(count), false, nullptr));
    Vector lower = points.front(), upper = lower;
    for (const Vector &point : points) {
      lower = lower.cwiseMin(point);
      upper = upper.cwiseMax(point);
    }
    centre = (lower + upper) / 2.0;
    radius = 0.0;
    for (const Vector &point : points) radius = std::max(radius, (point - centre).norm());
    while (points.size() % WIDTH) points.push_back(points.front());
    for (size_t k = 0; k < points.size(); k += WIDTH)
      for (int axis = 0; axis < 3; ++axis)
        for (int i = 0; i < WIDTH; ++i) corners_.push_back(points[k + i][axis]);
  }

  Kind kind_;
  Vector size_;
  std::vector<double> corners_;
  std::unique_ptr<coal::ShapeBase> coal_;
};

struct Placed {
  const Shape *shape;
  Pose pose;
  Vector centre;  // of its ball, in the world

  double support(const Vector &u) const {
    return u.dot(pose.p) + shape->support(pose.R.transpose() * u);
  }
};

// The gap between two pieces along a unit direction from a towards b; negative where they overlap.
double gap(const Placed &a, const Placed &b, const Vector &u) {
  return -b.support(-u) - a.support(u);
}

// Largest u.x over pieces.
double support(const std::vector<Placed> &pieces, const Vector &u) {
  double found = -INFINITE;
  for (const Placed &piece : pieces) found = std::max(found, piece.support(u));
  return found;
}

bool are_finite(const std::vector<Placed> &pieces) {
  return std::all_of(pieces.begin(), pieces.end(),
                     [](const Placed &piece) { return piece.centre.allFinite(); });
}

// Bounds of the distance of two pieces: lower along `direction`, a unit vector from the first towards
// the second; upper, negative where they surely intersect by as much.
struct Bounds {
  double lower, upper;
  Vector direction;
};

// Coal's algorithms on one pair after another; one per thread.
class Solver {
 public:
  // guess: direction from a towards b; zero for that between their centres. Stops early where they are
  // farther apart than `enough`, and looks for a depth up to `depth`.
  Bounds bounds(const Placed &a, const Placed &b, const Vector &guess, double enough, double depth) {
    Bounds found = run(a, b, guess, enough, depth);
    // Of round shapes, GJK may stop beside the nearest points where it began near them.
    if (found.upper > 0.0 && found.upper - found.lower > LOOSE && found.lower < enough) {
      const Bounds again = run(a, b, Vector::Zero(), enough, depth);
      if (again.lower > found.lower) {
        found.lower = again.lower;
        found.direction = again.direction;
      }
      found.upper = std::min(found.upper, again.upper);
    }
    return found;
  }

 private:
  Bounds run(const Placed &a, const Placed &b, Vector guess, double enough, double depth) {
    if (guess.isZero(0.0)) guess = b.centre - a.centre;
    if (guess.isZero(0.0)) guess = Vector::UnitX();
    difference_.set<coal::details::NoSweptSphere>(
        a.shape->coal(), b.shape->coal(), coal::Transform3s(a.pose.R, a.pose.p),
        coal::Transform3s(b.pose.R, b.pose.p));
    const Vector first = -(a.pose.R.transpose() * guess);
    gjk_.reset(GJK_STEPS, GJK_TOLERANCE);
    gjk_.setDistanceEarlyBreak(enough);
    const GJK::Status status = gjk_.evaluate(difference_, first, coal::support_func_guess_t::Zero());
    const double round = difference_.swept_sphere_radius.sum();
    const Vector &ray = gjk_.ray;
    const double length = ray.norm();
    Bounds found{-INFINITE, INFINITE, guess};
    if (length > 0.0) {
      const Vector u = a.pose.R * (-ray / length);
      const double along = gap(a, b, u);
      if (std::isfinite(along)) {
        found.lower = along;
        found.direction = u;
      }
    }
    if (status == GJK::Collision) {
      found.upper = -round - inner_radius(*gjk_.getSimplex());
      if (found.upper > -depth) found.upper = std::min(found.upper, -round - deeper(first));
    } else if (status != GJK::NoCollisionEarlyStopped && gjk_.getSimplex()->rank > 0) {
      found.upper = length - round;
    }
    return found;
  }

  // Radius of a ball about the origin inside a simplex, 0 if there is none.
  static double inner_radius(const GJK::Simplex &simplex) {
    if (simplex.rank < 4) return 0.0;
    double found = INFINITE;
    for (int k = 0; k < 4; ++k) {
      const Vector &a = simplex.vertex[k]->w, &b = simplex.vertex[(k + 1) % 4]->w,
                   &c = simplex.vertex[(k + 2) % 4]->w, &other = simplex.vertex[(k + 3) % 4]->w;
      const Vector normal = (b - a).cross(c - a);
      const double area = normal.norm(), side = normal.dot(other - a), origin = -normal.dot(a);
      if (!(area > 0.0) || !(std::abs(side) > 1e-12 * area) || !(origin * side > 0.0)) return 0.0;
      found = std::min(found, std::abs(origin) / area);
    }
    return found;
  }

  // The same inside the polytope of EPA.
  double deeper(const Vector &first) {
    epa_.reset(EPA_STEPS, EPA_TOLERANCE);
    epa_.evaluate(gjk_, -first);
    if (!(epa_.status & EPA::Valid)) return 0.0;
    return std::max(0.0, epa_.depth - difference_.swept_sphere_radius.sum() - EPA_TOLERANCE);
  }

  coal::details::MinkowskiDiff difference_;
  GJK gjk_{GJK_STEPS, GJK_TOLERANCE};
  EPA epa_{EPA_STEPS, EPA_TOLERANCE};
};

Solver &solver() {
  static thread_local Solver found;
  return found;
}

// Poses of all pieces: quaternion w, x, y, z and position, each number `stride` from the next.
struct Poses {
  const double *quaternions, *positions;
  std::int64_t stride;

  Pose of(std::int64_t piece) const {
    const double *q = quaternions + 4 * stride * piece, *at = positions + 3 * stride * piece;
    const double w = q[0], x = q[stride], y = q[2 * stride], z = q[3 * stride];
    Pose found;
    found.R << 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y);
    found.p << at[0], at[stride], at[2 * stride];
    return found;
  }
};

// The convex pieces of a cell's bodies.
class Bodies {
 public:
  // kinds (n,), sizes (n, 3) and numbers of corners (n,) of all pieces, the corners of hulls one after
  // the other; pieces of each body; index of the pose of each piece.
  Bodies(const Indices &kinds, const Numbers &sizes, const Indices &counts, const Numbers &corners,
         const Indices &first_piece, const Indices &poses)
      : first_(first_piece.data(), first_piece.data() + first_piece.size()),
        pose_(poses.data(), poses.data() + poses.size()) {
    const double *corner = corners.data();
    for (py::ssize_t k = 0; k < kinds.size(); ++k) {
      const Vector size(sizes.data()[3 * k], sizes.data()[3 * k + 1], sizes.data()[3 * k + 2]);
      shapes_.emplace_back(static_cast<Kind>(kinds.data()[k]), size, corner, counts.data()[k]);
      corner += 3 * counts.data()[k];
    }
  }

  // Bounds of the distance of two bodies. direction: from the first towards the second, zero if
  // unknown; updated.
  Bounds bounds(const Poses &poses, std::int64_t i, std::int64_t j, Vector &direction) const {
    const std::vector<Placed> &first = placed(poses, i, 0), &second = placed(poses, j, 1);
    if (!are_finite(first) || !are_finite(second)) return {-INFINITE, INFINITE, Vector::Zero()};
    Bounds nearest{INFINITE, INFINITE, direction};
    for (const Placed &a : first)
      for (const Placed &b : second) {
        const Vector between = b.centre - a.centre;
        if (between.norm() - a.shape->radius - b.shape->radius > nearest.upper) continue;
        const Bounds one = solver().bounds(a, b, direction, nearest.upper, 0.0);
        if (one.lower < nearest.lower) {
          nearest.lower = one.lower;
          nearest.direction = one.direction;
        }
        nearest.upper = std::min(nearest.upper, one.upper);
      }
    direction = nearest.direction;
    return nearest;
  }

  // Proof that two bodies are farther apart than `apart`, or intersect deeper than `overlap`.
  Verdict decide(const Poses &poses, std::int64_t i, std::int64_t j, double apart, double overlap,
                 double *hint) const {
    const std::vector<Placed> &first = placed(poses, i, 0), &second = placed(poses, j, 1);
    if (!are_finite(first) || !are_finite(second)) return OPEN;
    const Vector direction = Eigen::Map<const Vector>(hint);
    if (direction.squaredNorm() > 0.0) {
      if (-support(second, -direction) - support(first, direction) > apart) return APART;
    }
    Verdict found = APART;
    double least = INFINITE;
    for (const Placed &a : first)
      for (const Placed &b : second) {
        const Vector between = b.centre - a.centre;
        if (between.norm() - a.shape->radius - b.shape->radius > apart) continue;
        const Bounds one = solver().bounds(a, b, direction, apart, overlap);
        if (one.lower < least) {
          least = one.lower;
          Eigen::Map<Vector>{hint} = one.direction;
        }
        if (one.lower > apart) continue;
        if (one.upper < -overlap) return INTERSECTING;
        found = OPEN;
      }
    return found;
  }

  size_t size() const { return first_.size() - 1; }
  std::int64_t pieces() const { return static_cast<std::int64_t>(shapes_.size()); }

 private:
  const std::vector<Placed> &placed(const Poses &poses, std::int64_t body, int side) const {
    static thread_local std::vector<Placed> found[2];
    found[side].clear();
    for (std::int64_t k = first_[body]; k < first_[body + 1]; ++k) {
      const Pose pose = poses.of(pose_[k]);
      found[side].push_back({&shapes_[k], pose, pose.R * shapes_[k].centre + pose.p});
    }
    return found[side];
  }

  std::vector<Shape> shapes_;
  std::vector<std::int64_t> first_, pose_;
};

// Queries of pairs of bodies at m of n samples; each pair begins with the direction that the query of
// the same pair before found.
class Queries {
 public:
  Queries(const Bodies &bodies, const Numbers &quaternions, const Numbers &positions,
          const Indices &rows, const Indices &first, const Indices &second)
      : bodies_(bodies), quaternions_(quaternions.data()), positions_(positions.data()),
        pieces_(quaternions.size() ? quaternions.shape(1) : 0), rows_(rows.data()),
        first_(first.data()), second_(second.data()), count_(rows.size()) {}
  py::ssize_t count() const { return count_; }

  template <class Answer>
  void each(Answer answer) const {
    py::gil_scoped_release unlocked;
    const auto n = static_cast<std::int64_t>(bodies_.size());
    std::vector<double> directions(3 * n * n, 0.0);
    for (py::ssize_t k = 0; k < count_; ++k) {
      const Poses poses{quaternions_ + 4 * pieces_ * rows_[k], positions_ + 3 * pieces_ * rows_[k], 1};
      answer(k, poses, first_[k], second_[k], &directions[3 * (n * first_[k] + second_[k])]);
    }
  }

 private:
  const Bodies &bodies_;
  const double *quaternions_, *positions_;
  std::int64_t pieces_;
  const std::int64_t *rows_, *first_, *second_;
  py::ssize_t count_;
};

py::tuple distances(const Bodies &bodies, const Numbers &quaternions, const Numbers &positions,
                    const Indices &rows, const Indices &first, const Indices &second) {
  const Queries queries(bodies, quaternions, positions, rows, first, second);
  Numbers lower(queries.count()), upper(queries.count());
  double *low = lower.mutable_data(), *high = upper.mutable_data();
  queries.each([&](py::ssize_t k, const Poses &poses, std::int64_t i, std::int64_t j, double *hint) {
    Vector direction = Eigen::Map<Vector>(hint);
    const Bounds found = bodies.bounds(poses, i, j, direction);
    Eigen::Map<Vector>{hint} = direction;
    low[k] = found.lower;
    high[k] = found.upper;
  });
  return py::make_tuple(lower, upper);
}

py::array_t<std::int8_t> decide(const Bodies &bodies, const Numbers &quaternions,
                                const Numbers &positions, const Indices &rows, const Indices &first,
                                const Indices &second, const Numbers &apart, const Numbers &overlap) {
  const Queries queries(bodies, quaternions, positions, rows, first, second);
  py::array_t<std::int8_t> found(queries.count());
  std::int8_t *verdict = found.mutable_data();
  const double *least = apart.data(), *deep = overlap.data();
  queries.each([&](py::ssize_t k, const Poses &poses, std::int64_t i, std::int64_t j, double *hint) {
    verdict[k] = static_cast<std::int8_t>(bodies.decide(poses, i, j, least[k], deep[k], hint));
  });
  return found;
}

// `decide_pair` of kernel.c.
int decide_in_lane(const void *bodies, const double *quaternions, const double *positions,
                   long long stride, long long first, long long second, double apart, double overlap,
                   double *hint) {
  const Poses poses{quaternions, positions, stride};
  return static_cast<const Bodies *>(bodies)->decide(poses, first, second, apart, overlap, hint);
}

}  // namespace

PYBIND11_MODULE(_distances, module) {
  module.doc() = "Distances of convex pieces, and proofs that they are apart or intersect.";
  py::class_<Bodies>(module, "Bodies")
      .def(py::init<const Indices &, const Numbers &, const Indices &, const Numbers &, const Indices &,
                    const Indices &>())
      .def("distances", &distances)
      .def("decide", &decide)
      .def_property_readonly("address", [](const Bodies &bodies) {
        return reinterpret_cast<std::uintptr_t>(&bodies);
      });
  module.attr("COAL_VERSION") = COAL_VERSION;
  module.attr("DECIDE") = reinterpret_cast<std::uintptr_t>(&decide_in_lane);
}

// The rows of a smooth program: values, slopes, weighted second derivatives.
//
// `rows.py` lays the arrays out; `symbolic/smooth/path_points.py` has the formulas. Matrices that functions
// of CasADi return are transposed ones. Rows at places stand family by family.

#include "native.hpp"

#include <cstdint>
#include <optional>
#include <vector>

namespace {

constexpr Index POSE = 6, LOAD = 6;

// Share of the largest weight below which second derivatives are left out: those of rows that are far
// from ruling, whose multipliers vanish. It changes steps by as much, no solution.
constexpr double NEGLIGIBLE = 1e-7;

using Map = Eigen::Map<Matrix>;
using Chosen = std::vector<Index>;

using Numbers = py::array_t<double, py::array::c_style>;

// An array of NumPy itself, never a copy.
Numbers itself(const py::handle &array) {
  if (!py::isinstance<Numbers>(array)) throw py::type_error("an array of rows is not contiguous");
  return py::reinterpret_borrow<Numbers>(array);
}

// An array of NumPy where it is, by rows of `width` numbers.
Map shared(const py::handle &array, Index width) {
  Numbers found = itself(array);
  return {found.mutable_data(), found.size() / width, width};
}

// The same by its first index.
Map by_rows(const py::handle &array) {
  Numbers found = itself(array);
  Index width = 1;
  for (Index axis = 1; axis < found.ndim(); axis++) width *= found.shape(axis);
  return {found.mutable_data(), found.shape(0), width};
}

// Rows that have a weight above a least one.
template <class Weights>
Chosen above(double least, const Weights &weights) {
  Chosen chosen;
  for (Index k = 0; k < weights.rows(); k++)
    if (most(weights.row(k)) > least) chosen.push_back(k);
  return chosen;
}

[[noreturn]] void fail(const char *message) {
  py::set_error(py::module_::import("codegen.errors").attr("CodegenError"), message);
  throw py::error_already_set();
}

// A compiled function on arrays that were prepared for it, a `PreparedBatch`.
class Batch {
 public:
  explicit Batch(const py::object &of)
      : inputs(of.attr("inputs")), outputs(of.attr("outputs")), kept_(of) {
    const py::object found = of.attr("native");
    if (found.is_none()) fail("the polish needs compiled functions, and these are interpreted");
    const auto address = [&](const char *name) {
      return reinterpret_cast<void *>(found.attr(name).cast<std::uintptr_t>());
    };
    one_ = reinterpret_cast<Run>(address("one")), lanes_ = reinterpret_cast<Run>(address("lanes"));
    ports_ = address("ports"), work_ = address("work"), lane_work_ = address("lane_work");
  }

  Map input(const char *name) const { return by_rows(inputs[name]); }
  Map output(const char *name, Index width) const { return shared(outputs[name], width); }

  // The first `count` evaluations.
  void run(Index count) const {
    if (!count) return;
    const auto status = count > 1 && lanes_ ? lanes_(ports_, lane_work_, 0, count)
                                            : one_(ports_, work_, 0, count);
    if (status != DONE) fail("a function of the polish's rows failed");
  }

  py::dict inputs, outputs;

 private:
  using Run = long long (*)(const void *ports, const void *work, long long begin, long long end);

  static constexpr long long DONE = -1;

  py::object kept_;
  Run one_, lanes_;
  const void *ports_, *work_, *lane_work_;
};

// A function with first derivatives, and one with second ones, made when it is asked for: most rows
// never need it.
struct Derivatives {
  explicit Derivatives(const py::dict &of)
      : first(py::object(of["first"])), make(of["second"]) {}

  const Batch &second() {
    if (!made) made.emplace(make());
    return *made;
  }

  Batch first;
  py::object make;
  std::optional<Batch> made;
};

// Samples that one function gives.
struct Block : Derivatives {
  explicit Block(const py::dict &of)
      : Derivatives(of),
        start(of["start"].cast<Index>()),
        served(of["served"].cast<Index>()),
        basis(by_rows(of["basis"])) {}

  Index start, served;  // the first among all samples; samples of an evaluation
  Matrix basis;         // (evaluations, numbers of a basis)
};

// Some values of each of some samples.
struct Samples {
  explicit Samples(const py::dict &of)
      : x(shared(of["x"], py::len(of["x"]))),
        values(by_rows(of["values"])),
        gradients(shared(of["gradients"], x.cols())),
        weight(values.rows(), values.cols()) {
    for (const auto &block : of["blocks"]) blocks.emplace_back(block.cast<py::dict>());
  }

  void run(const Vector &at) {
    x.row(0) = at;
    for (const Block &block : blocks) block.first.run(block.basis.rows());
  }

  // Adds weighted second derivatives.
  void add_curvature(Matrix &to) {
    const Index n_var = x.cols(), width = weight.cols();
    const double least = NEGLIGIBLE * most(weight);
    for (Block &block : blocks) {
      const Map own(weight.row(block.start).data(), block.basis.rows(), width * block.served);
      const Chosen chosen = above(least, own);
      if (chosen.empty()) continue;
      const Batch &second = block.second();
      shared(second.inputs["x"], n_var) = x;
      Map basis = second.input("basis"), weights = second.input("weight");
      Index row = 0;
      for (const Index k : chosen)
        for (Index direction = 0; direction < n_var; direction++, row++) {
          basis.row(row) = block.basis.row(k);
          weights.row(row) = own.row(k);
        }
      second.run(row);
      const Map found = second.output("curvature", n_var);
      for (Index k = 0; k < row; k += n_var) to += found.middleRows(k, n_var);
    }
  }

  Map x, values, gradients;  // (1, n_var), (count, width), (count width, n_var)
  Matrix weight;             // (count, width)
  std::vector<Block> blocks;
};

// Samples whose forces are allocated jointly: these stand behind those of the paper's branches and
// follow from the loads' samples.
struct Held : Derivatives {
  explicit Held(const py::dict &of)
      : Derivatives(of),
        start(of["start"].cast<Index>()),
        at(of["at"].cast<Indices>()),
        loads(of["loads"].cast<py::dict>()),
        load(first.input("load")),
        state(by_rows(first.outputs["state"])),
        slope(first.output("slope", LOAD)) {}

  void run(const Vector &x) {
    loads.run(x);
    load = loads.values(at, Eigen::all);
    first.run(at.size());
  }

  // The gradients of forces from the loads'.
  void place_slopes(Samples &forces) const {
    for (Index k = 0; k < at.size(); k++)
      forces.gradients.middleRows(2 * (start + k), 2) =
          slope.middleRows(2 * k, 2) * loads.gradients.middleRows(LOAD * at[k], LOAD);
  }

  // Adds the weighted second derivatives of forces.
  void add_curvature(Matrix &to, const Samples &forces) {
    const auto weight = forces.weight.middleRows(start, at.size());
    const Chosen chosen = above(NEGLIGIBLE * most(forces.weight), weight);
    loads.weight.setZero();
    for (const Index k : chosen)
      loads.weight.row(at[k]) += weight.row(k) * slope.middleRows(2 * k, 2);
    loads.add_curvature(to);
    if (chosen.empty()) return;
    const Index count = chosen.size();
    second().input("weight").topRows(count) = weight(chosen, Eigen::all);
    second().input("state").topRows(count) = state(chosen, Eigen::all);
    second().run(count);
    const Map bent = second().output("curvature", LOAD);
    for (Index c = 0; c < count; c++) {
      const auto J = loads.gradients.middleRows(LOAD * at[chosen[c]], LOAD);
      to += J.transpose() * bent.middleRows(LOAD * c, LOAD) * J;
    }
  }

  Index start;             // the first among all of the forces' samples
  Indices at;              // (count,) each one's load
  Samples loads;
  Map load, state, slope;  // (count, LOAD), (count, numbers of a state), (2 count, LOAD)
};

// Rows of one family at places.
struct Group : Derivatives {
  explicit Group(const py::dict &of)
      : Derivatives(of),
        start(of["start"].cast<Index>()),
        moving(of["moving"].cast<bool>()),
        arms(of["arms"].cast<Indices>()),
        gradient(by_rows(first.outputs["gradient"])) {}

  Index start;   // the first of them
  bool moving;   // whether they depend on the box's rate
  Indices arms;  // on whose joints they depend
  Map gradient;
};

// An arm at the places where rows need it.
struct Arm : Derivatives {
  Arm(const py::dict &of, Index size)
      : Derivatives(of),
        place(of["place"].cast<Indices>()),
        at(of["at"].cast<Indices>()),
        basis(by_rows(of["basis"])),
        pose(first.input("pose")),
        q(by_rows(first.outputs["q"])),
        rows(by_rows(of["rows"])),
        follow(first.output("follow", q.cols())),
        pull(first.output("pull", q.cols())),
        pulls(place.size(), q.cols()),
        size_(size) {}

  void run(const Matrix &points) {
    if (!place.size()) return;
    pose = basis * points;
    first.run(place.size());
    rows = q(at, Eigen::all);
  }

  // (size, joints) how they follow the extended pose at a place.
  auto following(Index k) const { return follow.middleRows(size_ * k, size_); }

  Indices place;       // (places,) which ones
  Indices at;          // (n,) position of each row's place among them
  Matrix basis;        // (places, waypoints)
  Map pose, q, rows;   // (places, size), (places, joints), (n, joints)
  Map follow, pull;
  Matrix pulls;        // (places, joints) how much rows pull at joints

 private:
  Index size_;
};

// See `Rows` of `rows.py`.
class Rows {
 public:
  explicit Rows(const py::kwargs &of)
      : kept_(of),
        samples_(of["samples"].cast<py::dict>()),
        patches_(of["patches"].cast<py::dict>()),
        mix_(of["mix"].cast<Matrix>()),
        fixed_(of["fixed"].cast<Matrix>()),
        column_(of["column"].cast<Indices>()),
        pressed_(of["pressed"].cast<Indices>()),
        first_patch_(of["first_patch"].cast<Index>()),
        place_(of["place"].cast<Indices>()),
        order_(of["order"].cast<Indices>()),
        free_column_(of["free_column"].cast<Indices>()),
        scale_(of["scale"].cast<Vector>()),
        whole_(of["whole"].cast<Matrix>()),
        whole_rate_(of["whole_rate"].cast<Matrix>()),
        free_(of["free"].cast<Matrix>()),
        free_rate_(of["free_rate"].cast<Matrix>()),
        pose_(by_rows(of["pose"])),
        rate_(by_rows(of["rate"])),
        value_(by_rows(of["value"])),
        size_(of["size"].cast<Index>()) {
    if (!of["held"].is_none()) held_.emplace(of["held"].cast<py::dict>());
    for (const auto &group : of["groups"]) groups_.emplace_back(group.cast<py::dict>());
    for (const auto &arm : of["arms"]) arms_.emplace_back(arm.cast<py::dict>(), size_);
  }

  Vector values(const Vector &x, const Vector &tail, const Matrix &points) {
    const Index forces = column_.size();
    Vector out = fixed_ * tail;
    samples_.run(x);
    if (held_) held_->run(x);
    for (Index r = 0; r < forces; r++) out[r] += mix_.row(r).dot(samples_.values.row(column_[r]));
    if (lacking_.size()) out.head(forces) += lacking_ * (x - lacking_at_);
    patches_.run(x);
    for (Index r = 0; r < pressed_.size(); r++)
      out[first_patch_ + r] += patches_.values.data()[pressed_[r]];
    if (!order_.size()) return out;
    pose_ = whole_ * points.leftCols(POSE);
    rate_ = whole_rate_ * points.leftCols(POSE);
    for (Arm &arm : arms_) arm.run(points);
    for (const Group &group : groups_) group.first.run(group.gradient.rows());
    for (Index k = 0; k < order_.size(); k++) out[order_[k]] += value_(k, 0) / scale_[k];
    return out;
  }

  Matrix slopes() {
    const Index n_var = samples_.x.cols(), n_path = free_column_.size();
    Matrix out = Matrix::Zero(fixed_.rows(), n_var + fixed_.cols());
    out.rightCols(fixed_.cols()) = fixed_;
    if (held_) held_->place_slopes(samples_);
    for (Index r = 0; r < column_.size(); r++)
      out.row(r).head(n_var) = mix_.row(r) * samples_.gradients.middleRows(2 * column_[r], 2);
    if (lacking_.size()) out.topLeftCorner(column_.size(), n_var) += lacking_;
    for (Index r = 0; r < pressed_.size(); r++)
      out.row(first_patch_ + r).head(n_var) = patches_.gradients.row(pressed_[r]);
    for (const Group &group : groups_)
      for (Index k = group.start; k < group.start + group.gradient.rows(); k++) {
        const auto gradient = group.gradient.row(k - group.start);
        Vector by_pose = Vector::Zero(size_), by_rate = Vector::Zero(size_);
        by_pose.head(POSE) = gradient.head(POSE);
        if (group.moving) by_rate.head(POSE) = gradient.segment(POSE, POSE);
        for (const Index a : group.arms)
          by_pose += arms_[a].following(arms_[a].at[k]) * by_joints(group, a, k).transpose();
        auto row = out.row(order_[k]).head(n_path).array();
        row = free_.row(place_[k]).array() * by_pose(free_column_).transpose().array();
        row += free_rate_.row(place_[k]).array() * by_rate(free_column_).transpose().array();
        row /= scale_[k];
      }
    return out;
  }

  // Where the slopes were found last.
  Matrix curvature(const Vector &multipliers) {
    Matrix total = Matrix::Zero(samples_.x.cols(), samples_.x.cols());
    samples_.weight.setZero();
    for (Index r = 0; r < column_.size(); r++)
      samples_.weight.row(column_[r]) += multipliers[r] * mix_.row(r);
    samples_.add_curvature(total);
    if (held_) held_->add_curvature(total, samples_);
    patches_.weight.setZero();
    for (Index r = 0; r < pressed_.size(); r++)
      patches_.weight.data()[pressed_[r]] += multipliers[first_patch_ + r];
    patches_.add_curvature(total);
    const Vector weight = multipliers(order_).cwiseQuotient(scale_);
    for (Arm &arm : arms_) arm.pulls.setZero();
    for (Group &group : groups_)
      add_group(group, weight.segment(group.start, group.gradient.rows()), most(weight), total);
    for (Arm &arm : arms_) add_arm(arm, total);
    return total;
  }

  // Adds (forces, n_var) to the slopes of forces, and to values what that makes beside x.
  void correct(const Matrix &slope, const Vector &x) { lacking_ = slope, lacking_at_ = x; }

 private:
  // A row's gradient by the joints of one of its arms.
  Eigen::RowVectorXd by_joints(const Group &group, Index arm, Index k) const {
    const Index before = arm && !group.arms[0] ? arms_[0].q.cols() : 0;
    return group.gradient.row(k - group.start)
        .segment((group.moving ? 2 * POSE : POSE) + before, arms_[arm].q.cols());
  }

  // Adds left^T block right over the variables of the path.
  void add_block(const Matrix &block, Index place, const Matrix &left, const Matrix &right,
                 Matrix &to) const {
    const Index n = free_column_.size();
    to.topLeftCorner(n, n) += (left.row(place).transpose() * right.row(place))
                                  .cwiseProduct(block(free_column_, free_column_));
  }

  // H by the extended pose: by its first entries and by joints, which follow it by F (size, joints).
  Matrix reduced(const Matrix &H, const Matrix &F) const {
    Matrix T = Matrix::Zero(H.rows(), size_);
    T.topRows(H.rows() - F.cols()).diagonal().setOnes();
    T.bottomRows(F.cols()) = F.transpose();
    return T.transpose() * H * T;
  }

  // Adds the second derivatives of a group's rows with these weights.
  void add_group(Group &group, const Vector &weight, double largest, Matrix &to) {
    const Chosen chosen = above(NEGLIGIBLE * largest, weight);
    if (chosen.empty()) return;
    const Index count = chosen.size(), width = group.gradient.cols();
    const Batch &second = group.second();
    second.input("weight").col(0).head(count) = weight(chosen);
    for (const auto &[name, array] : group.first.inputs)
      by_rows(second.inputs[name]).topRows(count) = by_rows(array)(chosen, Eigen::all);
    second.run(count);
    const Map found = second.output("hessian", width);
    for (Index c = 0; c < count; c++) {
      const Index k = group.start + chosen[c], place = place_[k];
      const auto H = found.middleRows(c * width, width);
      if (group.moving) {
        const Matrix *bases[] = {&free_, &free_rate_};
        Matrix block = Matrix::Zero(size_, size_);
        for (int i = 0; i < 2; i++)
          for (int j = 0; j < 2; j++) {
            block.topLeftCorner(POSE, POSE) = H.block(POSE * i, POSE * j, POSE, POSE);
            add_block(block, place, *bases[i], *bases[j], to);
          }
        continue;
      }
      Matrix F(size_, width - POSE);
      Index before = 0;
      for (const Index a : group.arms) {
        Arm &arm = arms_[a];
        arm.pulls.row(arm.at[k]) += weight[chosen[c]] * by_joints(group, a, k);
        F.middleCols(before, arm.q.cols()) = arm.following(arm.at[k]);
        before += arm.q.cols();
      }
      add_block(reduced(H, F), place, free_, free_, to);
    }
  }

  // Adds what an arm's joints bend by following the box.
  void add_arm(Arm &arm, Matrix &to) {
    const Chosen chosen = above(0.0, arm.pulls);
    if (chosen.empty()) return;
    const Index count = chosen.size(), joints = arm.q.cols(), width = size_ + joints;
    const Batch &second = arm.second();
    second.input("pose").topRows(count) = arm.pose(chosen, Eigen::all);
    second.input("q").topRows(count) = arm.q(chosen, Eigen::all);
    Map nu = second.input("nu");
    for (Index c = 0; c < count; c++)
      nu.row(c) = arm.pulls.row(chosen[c]) *
                  arm.pull.middleRows(joints * chosen[c], joints).transpose();
    second.run(count);
    const Map found = second.output("hessian", width);
    for (Index c = 0; c < count; c++)
      add_block(reduced(found.middleRows(c * width, width), arm.following(chosen[c])),
                arm.place[chosen[c]], free_, free_, to);
  }

  py::kwargs kept_;  // with all arrays
  Samples samples_, patches_;
  std::optional<Held> held_;
  Matrix mix_, fixed_;         // (forces, 2), (n_rows, further variables)
  Indices column_, pressed_;   // of each force row its sample, of each patch its value
  Index first_patch_;
  Matrix lacking_;             // (forces, n_var), empty without
  Vector lacking_at_;
  Indices place_, order_;      // (n,) of each row at a place the place, and which row it is
  Indices free_column_;        // (n_path,)
  Vector scale_;               // (n,)
  Matrix whole_, whole_rate_;  // (n, waypoints)
  Matrix free_, free_rate_;    // (m, n_path) bases of every place, by variable
  Map pose_, rate_, value_;    // (n, POSE), (n, POSE), (n, 1)
  Index size_;                 // of the extended pose
  std::vector<Group> groups_;
  std::vector<Arm> arms_;
};

}  // namespace

PYBIND11_MODULE(_native, module) {
  module.doc() = "The polish's programs: their rows, and how they are solved.";
  module.def("dense", &dense);
  py::class_<Rows>(module, "Rows")
      .def(py::init<const py::kwargs &>())
      .def("values", &Rows::values)
      .def("slopes", &Rows::slopes)
      .def("curvature", &Rows::curvature)
      .def("correct", &Rows::correct);
}

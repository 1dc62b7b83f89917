// Convex quadratic programs of a border and a chain, by the method of `quadratic.py`, where its
// formulas and records are.
//
// Vectors of all variables hold the border first, then the chain.

#include "../native.hpp"

namespace {

constexpr int ITERATIONS = 50;  // at most; ten to twenty are the rule
// Share of the way to a bound that a step may take; least distance of the start from the bounds, as a
// share of their width; least slack and multiplier at the start.
constexpr double TO_BOUNDARY = 0.995, PUSH = 0.1, LEAST = 1e-2;
// Share of its terms that a proof of infeasibility leaves to rounding.
constexpr double ROUNDING = 1e-9;

struct Bordered {
  explicit Bordered(const py::object &of)
      : corner(of.attr("corner").cast<Matrix>()),
        beside(of.attr("beside").cast<Matrix>()),
        diagonal(of.attr("diagonal").cast<Array>()),
        off(of.attr("off").cast<Array>()) {}

  Array times(const Array &d) const {
    const Index k = corner.rows(), n = diagonal.size();
    const auto head = d.head(k), chain = d.tail(n);
    Array out(k + n);
    out.head(k).matrix() = corner * head.matrix() + beside.transpose() * chain.matrix();
    out.tail(n) = (beside * head.matrix()).array() + diagonal * chain;
    out.segment(k, n - 1) += off * chain.tail(n - 1);
    out.tail(n - 1) += off * chain.head(n - 1);
    return out;
  }

  Matrix corner, beside;  // (k, k) of the border, (n, k) of the chain by the border
  Array diagonal, off;    // (n,), (n - 1,) of the chain
};

struct Rows {
  explicit Rows(const py::object &of)
      : border(of.attr("border").cast<Matrix>()),
        column(of.attr("column").cast<Indices>()),
        left(of.attr("left").cast<Array>()),
        right(of.attr("right").cast<Array>()),
        n(of.attr("n_chain").cast<Index>()) {}

  Array times(const Array &d) const {
    const auto chain = d.tail(n);
    Array out = border * d.head(border.cols()).matrix();
    for (Index r = 0; r < left.size(); r++)
      out[r] += left[r] * chain[column[r]] + right[r] * chain[column[r] + 1];
    return out;
  }

  // Transposed rows times multipliers.
  Array pulled(const Array &y) const {
    Array out = Array::Zero(border.cols() + n);
    out.head(border.cols()).matrix() = border.transpose() * y.matrix();
    auto chain = out.tail(n);
    for (Index r = 0; r < left.size(); r++) {
      chain[column[r]] += left[r] * y[r];
      chain[column[r] + 1] += right[r] * y[r];
    }
    return out;
  }

  Matrix border;  // (rows, k)
  Indices column;
  Array left, right;
  Index n;
};

struct Program {
  explicit Program(const py::object &of)
      : H(of.attr("H")),
        A(of.attr("A")),
        g(of.attr("g").cast<Array>()),
        b(of.attr("b").cast<Array>()),
        low(of.attr("low").cast<Array>()),
        high(of.attr("high").cast<Array>()) {}

  Bordered H;
  Rows A;
  Array g, b, low, high;
};

// The inverse of H + A^T D A + E.
class Inverse {
 public:
  explicit Inverse(const Program &program) : p_(program), of_(program.H), along_(of_.off.size()) {}

  // Whether it is positive definite; D and E are diagonals.
  bool factorise(const Array &D, const Array &E) {
    const Index k = of_.corner.rows(), n = of_.diagonal.size();
    of_ = p_.H;
    const Rows &A = p_.A;
    weighted_ = D.matrix().asDiagonal() * A.border;
    add_products(of_.corner, A.border, weighted_);
    for (Index r = 0; r < D.size(); r++) {
      const double left = A.left[r], right = A.right[r];
      if (left == 0.0 && right == 0.0) continue;
      const Index c = A.column[r];
      of_.beside.row(c) += left * weighted_.row(r);
      of_.beside.row(c + 1) += right * weighted_.row(r);
      of_.diagonal[c] += D[r] * left * left;
      of_.diagonal[c + 1] += D[r] * right * right;
      of_.off[c] += D[r] * left * right;
    }
    of_.corner.diagonal().array() += E.head(k);
    pivot_ = of_.diagonal + E.tail(n);
    for (Index i = 0; i < n; i++) {
      if (i) pivot_[i] -= along_[i - 1] * of_.off[i - 1];
      if (!(pivot_[i] > 0.0)) return false;
      if (i + 1 < n) along_[i] = of_.off[i] / pivot_[i];
    }
    follow_ = of_.beside;
    solve_chain(follow_);
    add_products(of_.corner, -of_.beside, follow_);
    lower_.compute(of_.corner);
    return lower_.info() == Eigen::Success;
  }

  Array times(const Array &right) const {
    Vector out = right;
    auto head = out.head(of_.corner.rows()), chain = out.tail(of_.diagonal.size());
    solve_chain(chain);
    head.noalias() -= of_.beside.transpose() * chain;
    lower_.solveInPlace(head);
    chain.noalias() -= follow_ * head;
    return out;
  }

 private:
  // The chain's inverse times a matrix, in place.
  template <class Right>
  void solve_chain(Right &right) const {
    const Index n = pivot_.size();
    for (Index i = 1; i < n; i++) right.row(i) -= along_[i - 1] * right.row(i - 1);
    for (Index i = 0; i < n; i++) right.row(i) /= pivot_[i];
    for (Index i = n - 2; i >= 0; i--) right.row(i) -= along_[i] * right.row(i + 1);
  }

  const Program &p_;
  Bordered of_;
  Array pivot_, along_;         // of the chain, L D L^T
  Matrix follow_, weighted_;    // chain's inverse times beside; the rows' border times D
  Eigen::LLT<Matrix> lower_;    // of the border
};

// An iterate or its change: variables, slacks, multipliers of rows, of lower and of upper bounds.
struct State {
  State plus(double share, const State &by) const {
    return {d + share * by.d, s + share * by.s, y + share * by.y, low + share * by.low,
            high + share * by.high};
  }

  Array d, s, y, low, high;
};

double mean(const Program &p, const State &at) {
  const double of_bounds = ((at.d - p.low) * at.low + (p.high - at.d) * at.high).sum();
  return ((at.s * at.y).sum() + of_bounds) / double(at.s.size() + 2 * at.d.size());
}

double steepest(const Array &value, const Array &change) {
  return value.size() ? (-change / value).maxCoeff() : 0.0;
}

// Share of a change at which the first slack or multiplier is gone.
double longest(const Program &p, const State &now, const State &change) {
  return 1.0 / std::max({1e-300, steepest(now.s, change.s), steepest(now.y, change.y),
                         steepest(now.low, change.low), steepest(now.high, change.high),
                         steepest(now.d - p.low, change.d), steepest(p.high - now.d, -change.d)});
}

// What changes the products of rows and bounds by `goal`.
State changed(const Program &p, const Inverse &inverse, const State &now, const State &goal,
              const Array &slope, const Array &lack) {
  const Array to_low = now.d - p.low, to_high = p.high - now.d;
  const Array pull = p.A.pulled((goal.s + now.y * lack) / now.s);
  State out;
  out.d = inverse.times(goal.low / to_low - goal.high / to_high - slope - pull);
  out.s = -lack - p.A.times(out.d);
  out.y = (goal.s - now.y * out.s) / now.s;
  out.low = (goal.low - now.low * out.d) / to_low;
  out.high = (goal.high + now.high * out.d) / to_high;
  return out;
}

// Whether the rows, weighed by y, ask for more together than the bounds can give.
bool is_impossible(const Program &p, const Array &y, const Array &pull) {
  const double least = (pull * p.low).min(pull * p.high).sum();
  const double size = pull.abs().sum() + (p.b.abs() * y).sum();
  return least > (p.b * y).sum() + ROUNDING * size;
}

State begun(const Program &p) {
  const Array push = PUSH * (p.high - p.low);
  State now;
  now.d = Array::Zero(push.size()).max(p.low + push).min(p.high - push);
  now.low = LEAST / (now.d - p.low).max(LEAST);
  now.high = LEAST / (p.high - now.d).max(LEAST);
  now.s = (p.b - p.A.times(now.d)).max(LEAST);
  now.y = Array::Constant(p.b.size(), LEAST);
  return now;
}

// Iterates; how it ended, an `Ending`.
const char *solve(const Program &p, State &now, double tolerance) {
  Inverse inverse(p);
  for (int turn = 0; turn < ITERATIONS; turn++) {
    const Array pull = p.A.pulled(now.y), bend = p.H.times(now.d);
    const Array slope = bend + p.g + pull - now.low + now.high;
    const Array lack = p.A.times(now.d) + now.s - p.b;
    const double mu = mean(p, now), missing = most(lack);
    if (!std::isfinite(mu)) break;
    const double size = 1.0 + std::max(most(bend), most(pull));
    const double products = mu * double(now.s.size() + 2 * now.d.size());
    if (most(slope) / size <= tolerance && missing <= tolerance && products <= tolerance)
      return "solved";
    if (missing > tolerance && is_impossible(p, now.y, pull)) return "infeasible";
    const Array to_low = now.d - p.low, to_high = p.high - now.d;
    if (!inverse.factorise(now.y / now.s, now.low / to_low + now.high / to_high)) break;
    State goal;
    goal.s = -now.s * now.y;
    goal.low = -to_low * now.low;
    goal.high = -to_high * now.high;
    const State first = changed(p, inverse, now, goal, slope, lack);
    const double way = std::min(1.0, longest(p, now, first));
    const double reached = std::max(mean(p, now.plus(way, first)), 0.0) / mu;
    const double centre = mu * reached * reached * reached;
    goal.s += centre - first.s * first.y;
    goal.low += centre - first.d * first.low;
    goal.high += centre + first.d * first.high;
    const State second = changed(p, inverse, now, goal, slope, lack);
    const double share = std::min(1.0, TO_BOUNDARY * longest(p, now, second));
    if (!(share > tolerance)) break;
    now = now.plus(share, second);
  }
  return "failed";
}

}  // namespace

// The arguments of a `QuadraticAnswer` to a `QuadraticProgram`.
py::tuple quadratic(const py::object &program, double tolerance) {
  const Program p(program);
  State now = begun(p);
  const char *ending = solve(p, now, tolerance);
  return py::make_tuple(now.d, now.y, Array(now.high - now.low), ending);
}

// The dense interior-point method of `dense.py`, where its formulas are.
//
// Slacks, multipliers and their changes hold the m inequalities first, then the n lower and the n
// upper bounds.

#include "../native.hpp"

namespace {

// Least distance of the start from bounds, and what they are widened by, so that no rounding puts an
// iterate on one: shares of their width.
constexpr double PUSH = 1e-4, HAIR = 1e-8;
// Least slack at the start: rows nearer than that to their limit may come nearer for a while.
constexpr double SLACK = 1e-2;
// Times that the least slacks may be renewed where no step was found; trials of a line search.
constexpr int RENEWALS = 3, TRIALS = 8;
// The barrier falls to the smaller one of this share of it and this power; its problem counts as
// solved at this many times the barrier.
constexpr double LINEAR = 0.2, POWER = 1.5, SOLVED = 10.0;
// Share of the way to a bound that a step may take; factor to the multiplier of a row that shortened
// a step; least slack of all.
constexpr double TO_BOUNDARY = 0.99, RAISED = 10.0, LEAST = 1e-9;
// Share of the predicted gain that a step has to bring; price of a violation, over its multiplier.
constexpr double ARMIJO = 1e-4, PENALTY = 2.0;
// Least and largest share of a refused step that is tried next; parabolas tell which between.
constexpr double SHORTENED_LEAST = 0.1, SHORTENED_MOST = 0.7;
// Share of the largest multiplier below which a row's curvature, most of a step's cost and next to
// nothing of it, is left out; the same of rows whose slack exceeds their multiplier.
constexpr double NEGLIGIBLE = 1e-3, DISTANT = 2e-2;
// First shift of a matrix, as a share of its largest diagonal entry, and the factor to the next.
constexpr double SHIFT = 1e-7, SHIFTED = 8.0;
// Longest step, in widths of the box; longer ones come of matrices that are nearly singular.
constexpr double LONGEST = 2.0;
// Multipliers stay within this factor of what the barrier asks for.
constexpr double DUAL_RANGE = 1e10;

Array given(const py::object &program, const char *name) { return program.attr(name).cast<Array>(); }

class Solver {
 public:
  Solver(const py::object &program, double barrier)
      : program_(program), cost_(given(program, "cost")), mu_(barrier) {
    const Array low = given(program, "low"), high = given(program, "high"), hair = HAIR * (high - low);
    low_ = low - hair, high_ = high + hair;
    inner_low_ = low_ + 1e-3 * hair, inner_high_ = high_ - 1e-3 * hair;
    const Array push = PUSH * (high_ - low_);
    z_ = given(program, "start").max(low_ + push).min(high_ - push);
    std::tie(h_, A_) = program_.attr("rows")(z_).cast<std::pair<Array, Matrix>>();
    n_ = z_.size(), m_ = h_.size();
    slack_.resize(m_ + 2 * n_);
    slack_ << h_.max(SLACK), z_ - low_, high_ - z_;
    dual_ = barrier / slack_;
    dz_.resize(n_), change_.resize(slack_.size()), reached_.resize(slack_.size());
  }

  // Iterates until an optimum, or as often as wanted and until an iterate is feasible.
  py::tuple solve(int wanted, int patience, double tolerance, double feasible) {
    for (int iterations = 0;; iterations++) {
      const Errors errors = this->errors();
      const auto ended = [&](const char *how) { return py::make_tuple(z_, how, iterations); };
      if (errors.of(0.0) <= tolerance) return ended("Solve_Succeeded");
      if (iterations >= wanted && (-h_ <= feasible).all()) return ended("Stopped_Feasible");
      const double least = tolerance / SOLVED;
      while (mu_ > least && errors.of(mu_) <= SOLVED * mu_)
        mu_ = std::max(least, std::min(LINEAR * mu_, std::pow(mu_, POWER)));
      if (!advance() && !renew()) return ended("Step_Too_Short");
      if (iterations == patience * wanted) return ended("Maximum_Iterations_Exceeded");
    }
  }

 private:
  // Residuals: the largest without complementarity, the least and the largest product, their scale.
  struct Errors {
    // The largest one of a barrier's conditions, multipliers scaled as in the paper.
    double of(double mu) const { return std::max(rest, std::max(high - mu, mu - low) / scale); }

    double rest, low, high, scale;
  };

  Errors errors() const {
    const Array product = slack_ * dual_, lack = h_ - slack_.head(m_);
    const Array pulled = A_.transpose() * dual_.head(m_).matrix();
    const double scale = std::max(1.0, dual_.mean() / 100.0);
    const double steepest = most(cost_ - pulled - dual_.segment(m_, n_) + dual_.tail(n_));
    return {std::max(steepest / scale, most(lack)), product.minCoeff(), product.maxCoeff(), scale};
  }

  // One step; whether one was found, or will be with other multipliers.
  bool advance() {
    if (!find_direction()) return false;
    for (int trial = 0; trial < TRIALS; trial++) {
      values_ = program_.attr("values")(trial_).cast<Array>();
      if (is_taken()) {
        move();
        return true;
      }
    }
    return heed();
  }

  // A direction, and the first trial along it; whether there is one.
  bool find_direction() {
    const auto slack = slack_.head(m_), dual = dual_.head(m_);
    const double largest_dual = most(dual);
    const Array least = (slack > dual).select(Array::Constant(m_, DISTANT), NEGLIGIBLE) * largest_dual;
    const Array ruling = (dual > least).select(-dual, 0.0);
    const Array D = dual_ / slack_, r = h_ - slack;
    Matrix M = program_.attr("curvature")(z_, ruling).cast<Matrix>();
    M.diagonal().array() += D.segment(m_, n_) + D.tail(n_);
    add_products(M, A_, D.head(m_).matrix().asDiagonal() * A_);
    Array right = A_.transpose() * (mu_ / slack - D.head(m_) * r).matrix();
    right += mu_ / slack_.segment(m_, n_) - mu_ / slack_.tail(n_) - cost_;
    if (!solve_shifted(M, right)) return false;
    change_ << (A_ * dz_.matrix()).array() + r, dz_, -dz_;
    const Array share = change_ / slack_;
    by_dual_ = mu_ / slack_ - dual_ * share - dual_;
    const double theta = r.abs().sum();
    price_ = theta != 0.0 ? std::max(price_, PENALTY * largest_dual) : 0.0;
    slope_ = (cost_ * dz_).sum() - mu_ * share.sum() - price_ * theta;
    before_ = merit(z_, slack_, theta);
    alpha_ = longest(slack_, change_);
    blocking_ = Blocking::Constant(m_, false);
    place_trial();
    return true;
  }

  // M dz = right, M shifted until it is definite; whether there is a solution.
  bool solve_shifted(const Matrix &M, const Array &right) {
    const double scale = std::max(1.0, most(M.diagonal()));
    for (double shift = 0.0; std::isfinite(scale) && shift < 1e3 * scale;
         shift = std::max(SHIFT * scale, SHIFTED * shift)) {
      Matrix shifted = M;
      shifted.diagonal().array() += shift;
      const Eigen::LLT<Matrix> factor(shifted);
      if (factor.info() != Eigen::Success) continue;
      dz_.matrix() = factor.solve(right.matrix());
      if ((dz_.abs() <= LONGEST * (high_ - low_)).all()) return true;
    }
    return false;
  }

  // Judges the trial's values: whether it is taken; else a shorter one is placed.
  bool is_taken() {
    double share = SHORTENED_LEAST;
    if (values_.allFinite()) {
      const double lost = until_lost();
      if (lost > 0.0) {
        share = lost;
      } else {
        const auto slack = slack_.head(m_);
        const Array moved = (slack + alpha_ * change_.head(m_)).max(values_);
        reached_.head(m_) = (h_ >= slack).select(values_, moved).max(LEAST);
        reached_.tail(2 * n_) << trial_ - low_, high_ - trial_;
        const double theta = (values_ - reached_.head(m_)).abs().sum(), gain = slope_ * alpha_;
        const double more = merit(trial_, reached_, theta) - before_;
        if (more <= ARMIJO * gain + 1e-14 * std::max(1.0, std::abs(before_))) return true;
        share = -gain / (2.0 * (more - gain));
      }
    }
    // In this order, so that NaN becomes the least.
    alpha_ *= std::min(std::max(SHORTENED_LEAST, share), SHORTENED_MOST);
    place_trial();
    return false;
  }

  // Share of a step until rows that were lost reach a tenth of what they kept, on parabolas; 0 where
  // none was lost.
  double until_lost() {
    double first = INFINITY;
    for (Index k = 0; k < m_; k++) {
      const double value = slack_[k], change = alpha_ * change_[k];
      if (!(h_[k] >= value) || !(values_[k] < (1.0 - kept()) * value)) continue;
      const double bend = std::min(values_[k] - value - change, -1e-300), room = 0.9 * value;
      first = std::min(first, 2.0 * room / (std::sqrt(change * change - 4.0 * bend * room) - change));
      blocking_[k] = true;
    }
    return std::isfinite(first) ? first : 0.0;
  }

  // Moves to the trial that was taken.
  void move() {
    A_ = program_.attr("rows")(trial_).cast<std::pair<Array, Matrix>>().second;
    z_ = trial_, slack_ = reached_, h_ = values_;
    const Array ideal = mu_ / slack_, moved = dual_ + longest(dual_, by_dual_) * by_dual_;
    dual_ = moved.max(ideal / DUAL_RANGE).min(ideal * DUAL_RANGE);
    heed();
  }

  // Raises the multipliers of rows that shortened the last step; whether any was raised.
  bool heed() {
    const Array dual = dual_.head(m_), raised = dual.max((RAISED * dual).min(1.0));
    dual_.head(m_) = blocking_.select(raised, dual);
    return (blocking_ && raised > dual).any();
  }

  // Slacks as large as at the start; whether that changes anything.
  bool renew() {
    const Array old = slack_.head(m_), s = h_.max(std::min(SLACK, 10.0 * mu_));
    dual_.head(m_) = (s > old).select(mu_ / s, dual_.head(m_));
    slack_.head(m_) = s;
    const bool is_same = ((s - old).abs() <= 1e-8 + 1e-6 * old).all();
    return !is_same && renewals_++ < RENEWALS;
  }

  double kept() const { return std::max(TO_BOUNDARY, 1.0 - mu_); }

  double longest(const Array &value, const Array &change) const {
    const double steepest = (change / value).minCoeff();
    return steepest < 0.0 ? std::min(1.0, kept() / -steepest) : 1.0;
  }

  double merit(const Array &z, const Array &slack, double theta) const {
    return (cost_ * z).sum() - mu_ * slack.log().sum() + price_ * theta;
  }

  void place_trial() { trial_ = (z_ + alpha_ * dz_).max(inner_low_).min(inner_high_); }

  using Blocking = Eigen::Array<bool, Eigen::Dynamic, 1>;

  const py::object &program_;
  Index n_, m_;
  Array cost_, low_, high_, inner_low_, inner_high_;
  double mu_, price_ = 0.0, before_, slope_, alpha_;  // the last three of the search along dz
  int renewals_ = 0;
  Array z_, h_, slack_, dual_;  // the iterate
  Matrix A_;
  Array trial_, values_, reached_;
  Array dz_, change_, by_dual_;
  Blocking blocking_;  // rows that shortened the last step
};

}  // namespace

// Where a `Program` is minimal, how the search ended, and its iterations.
py::tuple dense(const py::object &program, double barrier, int wanted, int patience, double tolerance,
                double feasible) {
  return Solver(program, barrier).solve(wanted, patience, tolerance, feasible);
}

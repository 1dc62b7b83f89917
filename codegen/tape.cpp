// CasADi's instructions of a function of scalars, evaluated for many samples at once.
//
// CasADi's interpreter decodes every instruction for every sample. Here one decoded instruction runs
// over many samples, whose values lie side by side: the operations of compiled functions in the same
// order, with their sine and cosine, and so the same bits, without a compiler.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "c/one_lane.h"
#undef sin
#undef cos

namespace py = pybind11;

// One function for every kind of vectors: the loader takes the widest that the processor has.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define EVERY_WIDTH __attribute__((target_clones("avx512f", "avx2", "default")))
#define EACH_LANE _Pragma("GCC ivdep") for (int lane = 0; lane < LANES; ++lane)
#define INLINED inline __attribute__((always_inline))
#else
#define EVERY_WIDTH
#define EACH_LANE for (int lane = 0; lane < LANES; ++lane)
#define INLINED inline
#endif

namespace {

// Samples side by side: many in a block, few where few are left.
constexpr int MANY = 32, FEW = 8;

// Those of CasADi that are known here, by its names.
enum Operation {
  ASSIGN, CONST, INPUT, OUTPUT, ADD, SUB, MUL, DIV, NEG, SQ, TWICE, INV, SQRT, FABS, FMIN, FMAX, SIGN,
  LT, LE, EQ, NE, NOT, AND, OR, IF_ELSE_ZERO, SIN, COS, TAN, ASIN, ACOS, ATAN, ATAN2, EXP, LOG, POW,
  CONSTPOW, FLOOR, CEIL
};
const std::vector<std::string> OPERATIONS = {
    "ASSIGN", "CONST", "INPUT", "OUTPUT", "ADD",  "SUB",  "MUL", "DIV",          "NEG",   "SQ",
    "TWICE",  "INV",   "SQRT",  "FABS",   "FMIN", "FMAX", "SIGN", "LT",          "LE",    "EQ",
    "NE",     "NOT",   "AND",   "OR",     "IF_ELSE_ZERO", "SIN", "COS", "TAN",   "ASIN",  "ACOS",
    "ATAN",   "ATAN2", "EXP",   "LOG",    "POW",  "CONSTPOW", "FLOOR", "CEIL"};

using Numbers = py::array_t<double, py::array::c_style>;
using Codes = py::array_t<int, py::array::c_style | py::array::forcecast>;

// Operation, result, operands. Of an input or output the operands say which one, and which entry.
struct Instruction {
  int operation;
  int result;
  int first;
  int second;
  double constant;
};

// An array of samples, or with step 0 of one value for all; as `dual_arm_port` of codegen/c.
struct Port {
  double* values;
  std::ptrdiff_t step;
};

// `within` where an argument is within reach of its polynomials, else `of_large`. Results may lie
// where the arguments lie.
template <int LANES, typename Within, typename Large>
INLINED void each_angle(const double* x, double* r, Within within, Large of_large) {
  double angle[LANES];
  EACH_LANE angle[lane] = x[lane];
  EACH_LANE r[lane] = within(angle[lane]);
  for (int lane = 0; lane < LANES; ++lane)
    if (!(std::fabs(angle[lane]) <= SINCOS_REACH)) r[lane] = of_large(angle[lane]);
}

// Runs all instructions for samples begin to begin + count, at most LANES. `work` holds LANES values
// of every slot.
template <int LANES>
INLINED void run_lanes(const Instruction* instruction, std::size_t size, const Port* inputs,
               const Port* outputs, double* work, std::ptrdiff_t begin, int count) {
  for (const Instruction* end = instruction + size; instruction != end; ++instruction) {
    const int first = instruction->first, second = instruction->second;
    if (instruction->operation == OUTPUT) {
      const Port& port = outputs[instruction->result];
      const double* x = work + static_cast<std::ptrdiff_t>(first) * LANES;
      double* to = port.values + begin * port.step + second;
      for (int lane = 0; lane < count; ++lane) to[lane * port.step] = x[lane];
      continue;
    }
    double* r = work + static_cast<std::ptrdiff_t>(instruction->result) * LANES;
    if (instruction->operation == INPUT) {
      const Port& port = inputs[first];
      const double* from = port.values + begin * port.step + second;
      // Lanes beyond the last sample repeat it.
      for (int lane = 0; lane < LANES; ++lane) r[lane] = from[std::min(lane, count - 1) * port.step];
      continue;
    }
    const double* x = work + static_cast<std::ptrdiff_t>(first) * LANES;
    const double* y = work + static_cast<std::ptrdiff_t>(second) * LANES;
    switch (instruction->operation) {
      case CONST: EACH_LANE r[lane] = instruction->constant; break;
      case ASSIGN: EACH_LANE r[lane] = x[lane]; break;
      case ADD: EACH_LANE r[lane] = x[lane] + y[lane]; break;
      case SUB: EACH_LANE r[lane] = x[lane] - y[lane]; break;
      case MUL: EACH_LANE r[lane] = x[lane] * y[lane]; break;
      case DIV: EACH_LANE r[lane] = x[lane] / y[lane]; break;
      case NEG: EACH_LANE r[lane] = -x[lane]; break;
      case SQ: EACH_LANE r[lane] = x[lane] * x[lane]; break;
      case TWICE: EACH_LANE r[lane] = 2.0 * x[lane]; break;
      case INV: EACH_LANE r[lane] = 1.0 / x[lane]; break;
      case SQRT: EACH_LANE r[lane] = std::sqrt(x[lane]); break;
      case FABS: EACH_LANE r[lane] = std::fabs(x[lane]); break;
      // As `fmin` and `fmax`: a number wins against NaN.
      case FMIN: EACH_LANE r[lane] = x[lane] < y[lane] || y[lane] != y[lane] ? x[lane] : y[lane]; break;
      case FMAX: EACH_LANE r[lane] = x[lane] > y[lane] || y[lane] != y[lane] ? x[lane] : y[lane]; break;
      case SIGN: EACH_LANE r[lane] = x[lane] < 0.0 ? -1.0 : x[lane] > 0.0 ? 1.0 : x[lane]; break;
      case LT: EACH_LANE r[lane] = x[lane] < y[lane]; break;
      case LE: EACH_LANE r[lane] = x[lane] <= y[lane]; break;
      case EQ: EACH_LANE r[lane] = x[lane] == y[lane]; break;
      case NE: EACH_LANE r[lane] = x[lane] != y[lane]; break;
      case NOT: EACH_LANE r[lane] = x[lane] == 0.0; break;
      case AND: EACH_LANE r[lane] = x[lane] != 0.0 && y[lane] != 0.0; break;
      case OR: EACH_LANE r[lane] = x[lane] != 0.0 || y[lane] != 0.0; break;
      case IF_ELSE_ZERO: EACH_LANE r[lane] = x[lane] != 0.0 ? y[lane] : 0.0; break;
      case SIN:
        each_angle<LANES>(x, r, [](double a) { return dual_arm_sin_within_reach(a); },
                          [](double a) { return std::sin(a); });
        break;
      case COS:
        each_angle<LANES>(x, r, [](double a) { return dual_arm_cos_within_reach(a); },
                          [](double a) { return std::cos(a); });
        break;
      case TAN: EACH_LANE r[lane] = std::tan(x[lane]); break;
      case ASIN: EACH_LANE r[lane] = std::asin(x[lane]); break;
      case ACOS: EACH_LANE r[lane] = std::acos(x[lane]); break;
      case ATAN: EACH_LANE r[lane] = std::atan(x[lane]); break;
      case ATAN2: EACH_LANE r[lane] = std::atan2(x[lane], y[lane]); break;
      case EXP: EACH_LANE r[lane] = std::exp(x[lane]); break;
      case LOG: EACH_LANE r[lane] = std::log(x[lane]); break;
      case POW:
      case CONSTPOW: EACH_LANE r[lane] = std::pow(x[lane], y[lane]); break;
      case FLOOR: EACH_LANE r[lane] = std::floor(x[lane]); break;
      case CEIL: EACH_LANE r[lane] = std::ceil(x[lane]); break;
    }
  }
}

EVERY_WIDTH
void run_many(const Instruction* program, std::size_t size, const Port* inputs, const Port* outputs,
              double* work, std::ptrdiff_t begin, int count) {
  run_lanes<MANY>(program, size, inputs, outputs, work, begin, count);
}

EVERY_WIDTH
void run_few(const Instruction* program, std::size_t size, const Port* inputs, const Port* outputs,
             double* work, std::ptrdiff_t begin, int count) {
  run_lanes<FEW>(program, size, inputs, outputs, work, begin, count);
}

class Tape {
 public:
  // `codes` has a row of operation, result, operands for every instruction, `constants` an entry.
  // Throws std::out_of_range where an instruction names a slot that there is not.
  Tape(const Codes& codes, const Numbers& constants, int inputs, int slots)
      : inputs_(inputs), slots_(slots) {
    if (codes.ndim() != 2 || codes.shape(1) != 4 || constants.size() != codes.shape(0))
      throw std::out_of_range("instructions have another shape");
    for (py::ssize_t k = 0; k < codes.shape(0); ++k) {
      const Instruction one{codes.at(k, 0), codes.at(k, 1), codes.at(k, 2), codes.at(k, 3),
                            constants.data()[k]};
      const bool reads = one.operation == INPUT, writes = one.operation == OUTPUT;
      if (one.operation < 0 || one.operation >= static_cast<int>(OPERATIONS.size()))
        throw std::out_of_range("an operation is unknown");
      const bool inside = (writes || one.result < slots) && (reads || one.first < slots) &&
                          (reads || writes || one.second < slots);
      if (!inside || std::min({one.result, one.first, one.second}) < 0)
        throw std::out_of_range("an instruction is outside its work memory");
      program_.push_back(one);
    }
  }

  // Evaluates samples begin to end. `ports` has those of inputs, then those of outputs.
  void run(const Port* ports, double* work, std::ptrdiff_t begin, std::ptrdiff_t end) const {
    while (begin < end) {
      const auto run_block = end - begin > FEW ? run_many : run_few;
      const int most = end - begin > FEW ? MANY : FEW;
      const int count = static_cast<int>(std::min<std::ptrdiff_t>(most, end - begin));
      run_block(program_.data(), program_.size(), ports, ports + inputs_, work, begin, count);
      begin += count;
    }
  }

  std::size_t work_size() const { return static_cast<std::size_t>(slots_) * MANY; }

 private:
  std::vector<Instruction> program_;
  int inputs_, slots_;
};

// A tape with work memory: what C calls by address, as a driver of compiled functions (codegen/c).
struct Work {
  explicit Work(std::shared_ptr<const Tape> of) : tape(std::move(of)), memory(tape->work_size()) {}

  std::shared_ptr<const Tape> tape;
  std::vector<double> memory;
};

long long run_tape(const void* ports, const void* work, long long begin, long long end) {
  Work& own = *static_cast<Work*>(const_cast<void*>(work));
  own.tape->run(static_cast<const Port*>(ports), own.memory.data(), begin, end);
  return -1;
}

}  // namespace

PYBIND11_MODULE(_tape, module) {
  module.attr("OPERATIONS") = OPERATIONS;
  module.attr("RUN") = reinterpret_cast<std::uintptr_t>(&run_tape);
  py::class_<Tape, std::shared_ptr<Tape>>(module, "Tape")
      .def(py::init<const Codes&, const Numbers&, int, int>());
  py::class_<Work>(module, "Work")
      .def(py::init<std::shared_ptr<Tape>>())
      .def_property_readonly(
          "address", [](const Work& own) { return reinterpret_cast<std::uintptr_t>(&own); })
      .def(
          "run",
          [](Work& own, std::uintptr_t ports, std::ptrdiff_t begin, std::ptrdiff_t end) {
            run_tape(reinterpret_cast<const void*>(ports), &own, begin, end);
          },
          py::call_guard<py::gil_scoped_release>());
}

// CasADi's instructions of a function of scalars, evaluated for many samples at once.
//
// CasADi's interpreter decodes every instruction for every sample. Here one decoded instruction runs
// over `LANES` samples, whose values lie side by side: the same operations in the same order, and so
// the same bits, in a fraction of the time.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

namespace py = pybind11;

// One function for every kind of vectors: the loader takes the widest that the processor has.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define EVERY_WIDTH __attribute__((target_clones("avx512f", "avx2", "default")))
#define EACH_LANE _Pragma("GCC ivdep") for (int lane = 0; lane < LANES; ++lane)
#else
#define EVERY_WIDTH
#define EACH_LANE for (int lane = 0; lane < LANES; ++lane)
#endif

namespace {

constexpr int LANES = 32;

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

// Operation, result, operands. Of an input or output the operands say which one, and which entry.
struct Instruction {
  int operation;
  int result;
  int first;
  int second;
  double constant;
};

// An array of samples or of one value for all.
struct Port {
  double* values;
  std::ptrdiff_t step;
};

// Runs all instructions for samples begin to begin + count, at most LANES. `work` holds LANES values
// of every slot.
EVERY_WIDTH
void run_lanes(const Instruction* instruction, std::size_t size, const Port* inputs,
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
      case SIN: EACH_LANE r[lane] = std::sin(x[lane]); break;
      case COS: EACH_LANE r[lane] = std::cos(x[lane]); break;
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

class Tape {
 public:
  // Throws std::out_of_range where an instruction names a slot that there is not.
  Tape(const std::vector<int>& operations, const std::vector<int>& results,
       const std::vector<int>& first, const std::vector<int>& second,
       const std::vector<double>& constants, int slots)
      : slots_(slots) {
    for (std::size_t k = 0; k < operations.size(); ++k) {
      const Instruction one{operations[k], results.at(k), first.at(k), second.at(k),
                            constants.at(k)};
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

  // Evaluates `count` samples. Inputs hold a row per sample where `batched` says so, else one value
  // for all.
  void run(std::vector<Numbers> inputs, const std::vector<bool>& batched,
           std::vector<Numbers> outputs, std::ptrdiff_t count) const {
    std::vector<Port> from, to;
    for (std::size_t k = 0; k < inputs.size(); ++k)
      from.push_back(port(inputs[k], batched.at(k)));
    for (Numbers& output : outputs) to.push_back(port(output, true));
    py::gil_scoped_release release;
    std::vector<double> work(static_cast<std::size_t>(slots_) * LANES);
    for (std::ptrdiff_t begin = 0; begin < count; begin += LANES)
      run_lanes(program_.data(), program_.size(), from.data(), to.data(), work.data(), begin,
                static_cast<int>(std::min<std::ptrdiff_t>(LANES, count - begin)));
  }

 private:
  static Port port(Numbers& array, bool has_rows) {
    const bool steps = has_rows && array.size();
    return {const_cast<double*>(array.data()), steps ? array.size() / array.shape(0) : 0};
  }

  std::vector<Instruction> program_;
  int slots_;
};

}  // namespace

PYBIND11_MODULE(_tape, module) {
  module.attr("OPERATIONS") = OPERATIONS;
  py::class_<Tape>(module, "Tape")
      .def(py::init<const std::vector<int>&, const std::vector<int>&, const std::vector<int>&,
                    const std::vector<int>&, const std::vector<double>&, int>())
      .def("run", &Tape::run, py::arg("inputs").noconvert(), py::arg("batched"),
           py::arg("outputs").noconvert(), py::arg("count"));
}

// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs Ceres on one problem of the benchmarks and writes a trace; the command line and the files are those of
// trace.py and problem_file.py. --config: dense, sparse or iterative, with "-inner" for inner iterations of the points.

#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

struct Case {
  std::int64_t n_cameras = 0, n_points = 0, n_obs = 0, n_fixed = 0, size = 0;
  std::vector<std::int32_t> camera, point;
  std::vector<double> uv, cameras, points;
};

template <typename T>
std::vector<T> take(std::FILE* file, std::int64_t count) {
  std::vector<T> values(static_cast<std::size_t>(count));
  if (std::fread(values.data(), sizeof(T), values.size(), file) != values.size()) {
    throw std::runtime_error("the problem file is truncated");
  }
  return values;
}

Case read_case(const std::string& path) {
  std::FILE* file = std::fopen(path.c_str(), "rb");
  if (file == nullptr) throw std::runtime_error(path + ": cannot be opened");
  const auto head = take<std::int64_t>(file, 6);
  if (head[0] != 0x42414C31) throw std::runtime_error(path + ": not a problem of the benchmarks");
  Case c;
  c.n_cameras = head[1], c.n_points = head[2], c.n_obs = head[3], c.n_fixed = head[4], c.size = head[5];
  c.camera = take<std::int32_t>(file, c.n_obs);
  c.point = take<std::int32_t>(file, c.n_obs);
  c.uv = take<double>(file, 2 * c.n_obs);
  c.cameras = take<double>(file, 9 * c.n_cameras);
  c.points = take<double>(file, 3 * c.n_points);
  std::fclose(file);
  return c;
}

double memory_mb(const char* name) {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);) {
    if (line.rfind(name, 0) == 0) return std::atof(line.c_str() + std::strlen(name) + 1) / 1024.0;
  }
  return 0.0;
}

// The camera of BAL: p = -(X, Y) / Z, (u, v) = f (1 + k1 |p|^2 + k2 |p|^4) p.
template <typename T>
void project(const T* pose, const T& f, const T& k1, const T& k2, const T* point, const double* uv, T* residual) {
  T x[3];
  ceres::AngleAxisRotatePoint(pose, point, x);
  const T depth = x[2] + pose[5];
  const T a = -(x[0] + pose[3]) / depth;
  const T b = -(x[1] + pose[4]) / depth;
  const T s = a * a + b * b;
  const T scale = f * (1.0 + s * (k1 + s * k2));
  residual[0] = scale * a - uv[0];
  residual[1] = scale * b - uv[1];
}

struct Free {
  const double* uv;
  template <typename T>
  bool operator()(const T* camera, const T* point, T* residual) const {
    project(camera, camera[6], camera[7], camera[8], point, uv, residual);
    return true;
  }
};

struct Calibrated {
  const double* uv;
  const double* intrinsics;
  template <typename T>
  bool operator()(const T* pose, const T* point, T* residual) const {
    project(pose, T(intrinsics[0]), T(intrinsics[1]), T(intrinsics[2]), point, uv, residual);
    return true;
  }
};

class Recorder : public ceres::IterationCallback {
 public:
  explicit Recorder(Clock::time_point began) : began_(began) {}

  ceres::CallbackReturnType operator()(const ceres::IterationSummary& row) override {
    trace_.emplace_back(seconds(), row.cost);
    return ceres::SOLVER_CONTINUE;
  }

  double seconds() const { return std::chrono::duration<double>(Clock::now() - began_).count(); }
  const std::vector<std::pair<double, double>>& trace() const { return trace_; }

 private:
  Clock::time_point began_;
  std::vector<std::pair<double, double>> trace_;
};

using Arguments = std::map<std::string, std::string>;

Arguments parse(int argc, char** argv) {
  Arguments args{{"--config", "dense"},   {"--loss", "squared"},   {"--scale", "1"},
                 {"--iterations", "100"}, {"--tolerance", "1e-8"}, {"--threads", "1"}};
  for (int i = 1; i + 1 < argc; i += 2) args[argv[i]] = argv[i + 1];
  return args;
}

void build(ceres::Problem* problem, ceres::ParameterBlockOrdering* ordering, Case* c, ceres::LossFunction* loss) {
  for (std::int64_t i = 0; i < c->n_obs; ++i) {
    double* camera = c->cameras.data() + 9 * c->camera[i];
    double* point = c->points.data() + 3 * c->point[i];
    const double* uv = c->uv.data() + 2 * i;
    ceres::CostFunction* cost =
        c->size == 9 ? static_cast<ceres::CostFunction*>(new ceres::AutoDiffCostFunction<Free, 2, 9, 3>(new Free{uv}))
                     : new ceres::AutoDiffCostFunction<Calibrated, 2, 6, 3>(new Calibrated{uv, camera + 6});
    problem->AddResidualBlock(cost, loss, camera, point);
  }
  for (std::int64_t i = 0; i < c->n_points; ++i) {
    if (problem->HasParameterBlock(&c->points[3 * i])) ordering->AddElementToGroup(&c->points[3 * i], 0);
  }
  for (std::int64_t i = 0; i < c->n_cameras; ++i) {
    double* camera = c->cameras.data() + 9 * i;
    if (!problem->HasParameterBlock(camera)) continue;
    ordering->AddElementToGroup(camera, 1);
    if (i < c->n_fixed) problem->SetParameterBlockConstant(camera);
  }
}

ceres::Solver::Options solver_options(const Arguments& args) {
  ceres::Solver::Options options;
  const std::string& config = args.at("--config");
  options.linear_solver_type = ceres::DENSE_SCHUR;
  if (config.rfind("sparse", 0) == 0) options.linear_solver_type = ceres::SPARSE_SCHUR;
  if (config.rfind("iterative", 0) == 0) options.linear_solver_type = ceres::ITERATIVE_SCHUR;
  options.preconditioner_type = ceres::SCHUR_JACOBI;
  options.use_inner_iterations = config.find("-inner") != std::string::npos;
  options.max_num_iterations = std::stoi(args.at("--iterations"));
  options.function_tolerance = std::stod(args.at("--tolerance"));
  options.gradient_tolerance = 1e-16;
  options.parameter_tolerance = 1e-16;
  options.num_threads = std::stoi(args.at("--threads"));
  options.logging_type = ceres::SILENT;
  return options;
}

void write(const Arguments& args, const Case& c, const Recorder& recorder, double start_mb,
           const ceres::Solver::Summary& summary) {
  std::FILE* file = std::fopen(args.at("--trace").c_str(), "w");
  if (file == nullptr) throw std::runtime_error("the trace cannot be written");
  std::fprintf(file,
               "{\"version\": \"%s\", \"reason\": \"%s\", \"total_s\": %.9f, \"start_mb\": %.3f, \"peak_mb\": %.3f",
               CERES_VERSION_STRING, ceres::TerminationTypeToString(summary.termination_type), recorder.seconds(),
               start_mb, memory_mb("VmHWM"));
  std::fprintf(file, ", \"trace\": [");
  const char* comma = "";
  for (const auto& [time, cost] : recorder.trace()) {
    std::fprintf(file, "%s[%.9f, %.17g]", comma, time, cost);
    comma = ", ";
  }
  std::fprintf(file, "]}\n");
  std::fclose(file);
  std::FILE* state = std::fopen(args.at("--state").c_str(), "wb");
  if (state == nullptr) throw std::runtime_error("the state cannot be written");
  std::fwrite(c.cameras.data(), sizeof(double), c.cameras.size(), state);
  std::fwrite(c.points.data(), sizeof(double), c.points.size(), state);
  std::fclose(state);
}

void run(const Arguments& args) {
  Case c = read_case(args.at("--problem"));
  const double start_mb = memory_mb("VmRSS");
  Recorder recorder(Clock::now());
  ceres::Solver::Options options = solver_options(args);
  ceres::Problem problem;
  auto* ordering = new ceres::ParameterBlockOrdering;
  options.linear_solver_ordering.reset(ordering);
  ceres::LossFunction* loss = nullptr;
  if (args.at("--loss") == "huber") loss = new ceres::HuberLoss(std::stod(args.at("--scale")));
  build(&problem, ordering, &c, loss);
  if (options.use_inner_iterations) {
    options.inner_iteration_ordering.reset(new ceres::ParameterBlockOrdering);
    for (std::int64_t i = 0; i < c.n_points; ++i) {
      if (problem.HasParameterBlock(&c.points[3 * i])) {
        options.inner_iteration_ordering->AddElementToGroup(&c.points[3 * i], 0);
      }
    }
  }
  options.callbacks.push_back(&recorder);
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  write(args, c, recorder, start_mb, summary);
}

}  // namespace

int main(int argc, char** argv) {
  try {
    run(parse(argc, argv));
  } catch (const std::exception& error) {
    std::fprintf(stderr, "ceres_driver: %s\n", error.what());
    return 1;
  }
  return 0;
}

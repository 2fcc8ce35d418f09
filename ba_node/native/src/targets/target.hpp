// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The kernels as they are compiled for several processors, and the choice between them: what bindings/ sees of them.
#pragma once

#include <cstdint>

#include "adjustment/types.hpp"
#include "front_end/types.hpp"
#include "linalg/types.hpp"

namespace ba {

struct KernelArguments {
  ProblemView problem;
  CostModel cost;
  StateView start{};
  CoupledPairs factors;  // pairs of free keyframes that have a block of B between them
  int threads = 1;
};

// One problem with d = 6 or 9 unknowns a keyframe; adjustment/kernel.hpp.
class Kernel {
 public:
  virtual ~Kernel();

  // d.
  virtual int size() const = 0;
  virtual std::int64_t n_free() const = 0;
  virtual std::int64_t n_edges() const = 0;
  virtual std::int64_t n_pairs() const = 0;
  virtual std::int64_t n_points() const = 0;
  virtual std::int64_t n_chunks() const = 0;
  virtual double gradient_norm() const = 0;

  virtual double objective(const StateView& s) = 0;
  // Improve each point alone, keyframes fixed. points: out.
  virtual Objectives inner_iterations(const StateView& s, double* points, int steps) = 0;
  virtual double linearise(const StateView& s) = 0;
  // Linearise where the last step ended; false if there is no such state.
  virtual bool linearise_prepared() = 0;
  // Add what factors have at the state of the last linearisation: to B (n_free x 36), to the gradient (n_free x 6), and
  // the blocks of the coupled pairs (n_pairs x 36).
  virtual void add_factors(const double* diagonal, const double* gradient, const double* pairs) = 0;
  // The keyframes' part of the gradient (n_free x d).
  virtual void gradient(double* out) const = 0;
  // diag(B) (n_free x d) and diag(C) (n_points x 3).
  virtual void diagonals(double* d_c, double* d_p) const = 0;

  // Add damping to the diagonals and factor C; everything below is of this damped system.
  virtual void factor(const double* damping_c, const double* damping_p) = 0;
  // The same with mu times the diagonal itself, or the identity.
  virtual void damp(bool diagonal, double mu) = 0;
  // |D x|^2 of a step of the free keyframes (n_free x d), with D^2 the same diagonal or the identity.
  virtual double length2(bool diagonal, const double* x) const = 0;
  virtual void rhs(double* out) = 0;
  // S, symmetric, (n x n), n = n_free d.
  virtual void dense(double* out) = 0;
  // The pattern of the upper triangle of S; its blocks (d x d), block k to place[k] of out, and transposed to
  // mirrored[k] unless that is negative.
  virtual const Rows32& schur_pattern() = 0;
  virtual void sparse(const std::int64_t* place, const std::int64_t* mirrored, double* out) = 0;
  // S x without forming S, and the diagonal blocks of S, (n_free x d x d).
  virtual void product(const double* x, double* out) = 0;
  virtual void diagonal_blocks(double* out) = 0;

  // Solve S x = rhs by dense Cholesky, or by sparse Cholesky after analyse; false if S is not positive definite.
  virtual bool solve(double* x) = 0;
  virtual const Fill& analyse(const FillLimits& limits) = 0;
  virtual bool solve_sparse(double* x) = 0;
  // By conjugate gradients; scale: 1/D (n_free x d). formed: products with S by blocks, summed first; otherwise
  // without.
  virtual PcgEnd pcg(const double* scale, Preconditioner kind, const PcgLimits& limits, bool formed, double* x) = 0;

  // Step of the points for a step of the free keyframes (n_free x d); returns the reduction of the undamped model.
  virtual double back_substitute(const double* step_c, double* step_p) = 0;
  // Take a step of the free keyframes (n_free x d) and those of the points that go with it from `from` to `to`, and
  // iterate on the points after it. Objectives are not numbers where the state after the step is not finite. What was
  // kept of the linearisation is written over: another has to follow.
  virtual StepResult step(const StateView& from, const double* step_c, int steps, const StateSpan& to) = 0;
};

// Factors on relative poses; adjustment/relative_poses.hpp.
class RelativePoseFactors {
 public:
  virtual ~RelativePoseFactors();

  // 1/2 sum Psi.
  virtual double value(const StateView& s) const = 0;
  // The same; adds what belongs to the gradient and to the blocks.
  virtual double linearise(const StateView& s, const FactorSums& out) const = 0;
};

// The sparse Cholesky factor of a symmetric matrix by d x d blocks, for sums of S; linalg/sparse_cholesky.hpp.
class SparseFactor {
 public:
  virtual ~SparseFactor();

  // blocks: of the upper triangle in the order of the pattern, (n_blocks x d x d). x: right-hand side in, solution out.
  // False if the matrix is not positive definite.
  virtual bool solve(const double* blocks, double* x) = 0;
};

// What is compiled for one kind of processor.
struct Target {
  const char* name;
  Kernel* (*make_kernel6)(KernelArguments&&);
  Kernel* (*make_kernel9)(KernelArguments&&);
  // upper: rows of the upper triangle with the diagonal first.
  SparseFactor* (*make_factor6)(const Rows32& upper);
  SparseFactor* (*make_factor9)(const Rows32& upper);
  RelativePoseFactors* (*make_relative_poses)(const RelativePosesView&);
  void (*residual_norms)(const ProblemView&, const StateView&, double* out);
  bool (*resect)(const ProblemView&, const StateView& start, std::int64_t keyframe, const CostModel&,
                 const ResectionLimits&, double* pose, bool* alone);
  void (*triangulate)(const RaysView&, std::int64_t n_points, double* points, double* parallax, bool* measured);
  void (*agreeing)(const RaysView&, std::int64_t n_points, double gate, bool* agrees);
  void (*consensus)(const RaysView&, std::int64_t n_points, double gate, double* points, double* parallax,
                    bool* measured, bool* agrees);
  void (*cut_patches)(const ImageView&, const double* uv, std::int64_t n, const float* offsets, std::int64_t m,
                      float* out);
  void (*align_patches)(const ImageView&, const PatchesView&, const AlignLimits&, const double* bend,
                        const PlacesSpan&);
  void (*pose_equations)(const SeenView&, const double* rotation, const double* translation, double cauchy,
                         const PoseEquationsSpan&);
};

#define BA_DECLARE_TARGET(name)                      \
  namespace name {                                   \
  extern const Target kTarget;                       \
  Kernel* make_kernel6(KernelArguments&& arguments); \
  Kernel* make_kernel9(KernelArguments&& arguments); \
  SparseFactor* make_factor6(const Rows32& upper);   \
  SparseFactor* make_factor9(const Rows32& upper);   \
  }
BA_DECLARE_TARGET(baseline)
BA_DECLARE_TARGET(avx2)
BA_DECLARE_TARGET(avx512)
#undef BA_DECLARE_TARGET

}  // namespace ba

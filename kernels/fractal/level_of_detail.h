#pragma once
// How deep to refine by distance, how patches of different depth meet, and how a cell is cut into triangles.
// Source: Hu & Wang sections 3.1-3.3; SPEC-SYNTHESIS 5.5, 5.6, 5.8.

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace lodestone {

// A pinhole camera of field of view `fov_rad` (0 .. pi) on a plane `width_px` wide; tolerance_px > 0.
struct ProjectionRule {
  double fov_rad = 1.0471975511965976;
  double width_px = 1024;
  double tolerance_px = 2;
};

// Pixels that a segment of length_m, parallel to the plane at distance_m > 0, covers.
double projected_px(double length_m, double distance_m, const ProjectionRule& rule);

// The distance beyond which a segment of length_m covers less than the tolerance (eq. 3 of the paper,
// solved).
double distance_threshold_m(double length_m, const ProjectionRule& rule);

// Smallest n with projected_px(spacing_m / 2^n) <= tolerance, in 0..max_iterations. distance_m <= 0 gives
// max_iterations.
int fractal_iterations(double spacing_m, double distance_m, int max_iterations, const ProjectionRule& rule);

// The edge that a patch `levels` finer shares with a coarser one: the polyline of the coarser edge at every
// fine post, (coarse_m.size() - 1) 2^levels + 1 heights. Both patches draw it, so no crack is left.
std::vector<float> shared_edge(std::span<const float> coarse_m, int levels);

enum class Diagonal : std::uint8_t { kNorthWestSouthEast, kNorthEastSouthWest };

// The diagonal with the smaller height difference; north-west - south-east if both are equal.
Diagonal shorter_diagonal(float nw, float ne, float sw, float se);
// Joins the two lowest corners; where they are neighbours (or not the only two lowest), the shorter diagonal.
Diagonal lowest_diagonal(float nw, float ne, float sw, float se);

using Vector3 = std::array<double, 3>;
// Outward normal (B - A) x (C - B) of a counter-clockwise triangle, not normalised.
Vector3 triangle_normal(const Vector3& a, const Vector3& b, const Vector3& c);
// Seen from `eye`: normal . (eye - a) > 0; edge-on is invisible.
bool is_facing(const Vector3& a, const Vector3& b, const Vector3& c, const Vector3& eye);

}  // namespace lodestone

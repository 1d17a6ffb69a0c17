#pragma once
// Rounding of served heights to a power of two: files get 3-4 times smaller, and neighbouring tiles keep equal borders because
// the quantum depends on nothing that differs between tiles of a level.

#include <span>

#include "kernels/types/result.h"

namespace lodestone {

inline constexpr float kMinQuantumM = 0x1p-10f;
inline constexpr float kMaxQuantumM = 0x1p6f;

// A quantum is a power of two of metres, 2^-10 (about 1 mm) to 2^6 (64 m). Error: kInvalidArgument.
Result<void> check_quantum(float quantum_m);

// Rounds every height in place to the nearest multiple of quantum_m, ties to the even multiple; -0 becomes 0. The result
// depends on the height alone and rounding again changes nothing. Heights of 2^24 quanta and more, infinities and NaN stay as
// they are (such floats are whole multiples already). Error: as check_quantum; heights are then untouched.
Result<void> quantise(std::span<float> heights_m, float quantum_m);

// The quantum of `?quantum=auto`. max_abs_height_m: largest absolute height of the LAYER; spacing_m: post spacing of the LEVEL on
// the ground; never values of a tile.
//   fine  = largest power of two <= min(1/16 m, spacing_m / 256): the error of half a quantum tilts a cell by 1/512 at most
//   exact = smallest power of two with 17/16 max_abs_height_m <= 65536 quanta: a PXR24 sample has 16 significant bits, so it
//           holds every such multiple exactly; 1/16 is room for detail above the layer's summit
//   quantum = max(fine, exact), kept within kMinQuantumM..kMaxQuantumM. `exact` wins: PXR24 stays lossless.
// Values that are not positive or not finite count as 0 (height) or as wide (spacing).
float auto_quantum(double max_abs_height_m, double spacing_m);

}  // namespace lodestone

#include "storage/formats/quantum.h"

#include <algorithm>
#include <cmath>
#include <string>

namespace lodestone {

Result<void> check_quantum(float quantum_m) {
  int exponent = 0;
  const bool is_power = std::isfinite(quantum_m) && std::frexp(quantum_m, &exponent) == 0.5f;
  if (!is_power || quantum_m < kMinQuantumM || quantum_m > kMaxQuantumM) {
    char text[32];
    std::snprintf(text, sizeof text, "%.9g", static_cast<double>(quantum_m));
    return Error{ErrorCode::kInvalidArgument, std::string("quantum: a power of two between 2^-10 = 0.0009765625 and 2^6 = 64 "
                                                          "metres (0.0625, 0.125, 0.25, ...) or auto, got ") +
                                                  text};
  }
  return {};
}

Result<void> quantise(std::span<float> heights_m, float quantum_m) {
  if (auto ok = check_quantum(quantum_m); !ok) return ok;
  // Between 2^23 and 2^24 quanta neighbouring floats lie one quantum apart: adding `shift` rounds, and taking it away again is exact.
  const float shift = 0x1.8p23f * quantum_m;
  const float fits_m = 0x1p22f * quantum_m;
  for (float& h : heights_m) {
    if (std::fabs(h) < fits_m) {
      h = ((h + shift) - shift) + 0.0f;
    } else if (std::fabs(h) < 0x1p24f * quantum_m) {
      h = std::nearbyint(h / quantum_m) * quantum_m;
    }
  }
  return {};
}

float auto_quantum(double max_abs_height_m, double spacing_m) {
  double fine = 0x1p-4;
  if (spacing_m > 0 && std::isfinite(spacing_m)) {
    while (fine > spacing_m / 256 && fine > kMinQuantumM) fine /= 2;
  }
  double exact = kMinQuantumM;
  if (max_abs_height_m > 0 && std::isfinite(max_abs_height_m)) {
    while (max_abs_height_m * (17.0 / 16.0) > 65536.0 * exact && exact < kMaxQuantumM) exact *= 2;
  }
  return static_cast<float>(std::max(fine, exact));
}

}  // namespace lodestone

#pragma once
// The one table from error codes to HTTP statuses.

#include <string_view>

#include "kernels/types/result.h"

namespace lodestone::http {

// The status of an answer that failed with `code`.
int status_from_error(ErrorCode code);
// A stable machine-readable word: "not_found".
std::string_view word_from_error(ErrorCode code);
// The reason phrase of a status line; "Unknown" for statuses that we never send.
std::string_view reason_phrase(int status);

}  // namespace lodestone::http

#include "service/http/status.h"

namespace lodestone::http {
namespace {

struct Row {
  ErrorCode code;
  int status;
  std::string_view word;
};
constexpr Row kTable[] = {
    {ErrorCode::kInvalidArgument, 400, "invalid_argument"},
    {ErrorCode::kNotFound, 404, "not_found"},
    {ErrorCode::kGone, 410, "gone"},
    {ErrorCode::kTooLarge, 413, "too_large"},
    {ErrorCode::kUnsupported, 422, "unsupported"},
    {ErrorCode::kConflict, 409, "conflict"},
    {ErrorCode::kOverloaded, 503, "overloaded"},
    {ErrorCode::kCancelled, 503, "cancelled"},
    {ErrorCode::kCorrupt, 500, "corrupt"},
    {ErrorCode::kDevice, 503, "device"},
    {ErrorCode::kIo, 503, "io"},
    {ErrorCode::kInternal, 500, "internal"},
};

}  // namespace

int status_from_error(ErrorCode code) {
  for (const Row& row : kTable)
    if (row.code == code) return row.status;
  return 500;
}

std::string_view word_from_error(ErrorCode code) {
  for (const Row& row : kTable)
    if (row.code == code) return row.word;
  return "internal";
}

std::string_view reason_phrase(int status) {
  switch (status) {
    case 100: return "Continue";
    case 200: return "OK";
    case 201: return "Created";
    case 202: return "Accepted";
    case 204: return "No Content";
    case 206: return "Partial Content";
    case 301: return "Moved Permanently";
    case 302: return "Found";
    case 303: return "See Other";
    case 304: return "Not Modified";
    case 307: return "Temporary Redirect";
    case 308: return "Permanent Redirect";
    case 400: return "Bad Request";
    case 401: return "Unauthorized";
    case 403: return "Forbidden";
    case 404: return "Not Found";
    case 405: return "Method Not Allowed";
    case 406: return "Not Acceptable";
    case 408: return "Request Timeout";
    case 409: return "Conflict";
    case 410: return "Gone";
    case 412: return "Precondition Failed";
    case 413: return "Content Too Large";
    case 414: return "URI Too Long";
    case 415: return "Unsupported Media Type";
    case 417: return "Expectation Failed";
    case 422: return "Unprocessable Content";
    case 429: return "Too Many Requests";
    case 431: return "Request Header Fields Too Large";
    case 500: return "Internal Server Error";
    case 501: return "Not Implemented";
    case 503: return "Service Unavailable";
    case 504: return "Gateway Timeout";
    case 505: return "HTTP Version Not Supported";
    default: return "Unknown";
  }
}

}  // namespace lodestone::http

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include "storage/dem/layer_store.h"

namespace lodestone {

Result<FileLock> FileLock::acquire(const std::filesystem::path& path, const std::string& what) {
  const int fd = ::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
  if (fd < 0) {
    return Error{ErrorCode::kIo, "lock file " + path.string() + " cannot be opened: " + std::strerror(errno)};
  }
  if (::flock(fd, LOCK_EX | LOCK_NB) != 0) {
    char text[32] = {};
    const ssize_t read_bytes = ::pread(fd, text, sizeof text - 1, 0);
    ::close(fd);
    const std::string holder =
        read_bytes > 0 ? std::string("process ") + text : std::string("another process");
    return Error{ErrorCode::kConflict, what + " is in use by " + holder + " (lock " + path.string() +
                                           "); stop it or wait until it is done"};
  }
  // The holder's pid is for the message only; the lock itself is the kernel's and dies with the process.
  const std::string pid = std::to_string(::getpid());
  if (::ftruncate(fd, 0) != 0 || ::pwrite(fd, pid.data(), pid.size(), 0) < 0) {
    // A full disk must not keep us from locking: the message will then say "another process".
  }
  return FileLock(fd);
}

FileLock::FileLock(FileLock&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}

FileLock& FileLock::operator=(FileLock&& other) noexcept {
  std::swap(fd_, other.fd_);
  return *this;
}

FileLock::~FileLock() {
  if (fd_ >= 0) ::close(fd_);
}

}  // namespace lodestone

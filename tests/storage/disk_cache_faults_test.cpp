// What the world does to a disk cache: kills, flipped bits, cut files, full and read-only and vanishing disks.
#include <fcntl.h>
#include <poll.h>
#include <sys/mount.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <fstream>
#include <functional>
#include <set>
#include <thread>

#include "tests/support/disk_cache_fixture.h"

#ifdef __SANITIZE_THREAD__
// The kill test's children start threads after fork, each in a copy of a process that has none of its own.
extern "C" const char* __tsan_default_options() { return "die_after_fork=0"; }
#endif

namespace lodestone {
namespace {

using namespace std::chrono_literals;
constexpr std::uint64_t kMiB = 1 << 20;

class DiskCacheFaults : public DiskCacheTest {
 protected:
  std::string data_bytes() const {
    std::ifstream in(data_file(), std::ios::binary);
    return {std::istreambuf_iterator<char>(in), {}};
  }
  void write_data(const std::string& bytes) const {
    std::filesystem::create_directories(directory());
    std::ofstream(data_file(), std::ios::binary | std::ios::trunc) << bytes;
  }
  void flip(std::uint64_t at, int bit) const {
    const int fd = ::open(data_file().c_str(), O_RDWR);
    char byte = 0;
    if (fd < 0 || ::pread(fd, &byte, 1, at) != 1) return (void)::close(fd);
    byte ^= static_cast<char>(1 << bit);
    EXPECT_EQ(::pwrite(fd, &byte, 1, at), 1);
    ::close(fd);
  }
  static bool wait_for(const std::function<bool()>& is_so) {
    for (int i = 0; i < 150; ++i) {
      if (is_so()) return true;
      std::this_thread::sleep_for(100ms);
    }
    return false;
  }
};

TEST_F(DiskCacheFaults, SurvivesFiftyKills) {
  std::mt19937_64 random(5);
  std::set<std::uint64_t> acknowledged;  // the budget holds them all, so none may be missing
  for (int round = 0; round < 50; ++round) {
    int ends[2];
    ASSERT_EQ(::pipe(ends), 0);
    const std::uint64_t first = 100000 + 1000 * round;
    const pid_t child = ::fork();
    ASSERT_GE(child, 0);
    if (child == 0) {
      ::close(ends[0]);
      const auto cache = DiskCache::open(options(512 * kMiB));
      for (std::uint64_t i = first; i < first + 400; i += 5) {
        for (std::uint64_t j = i; j < i + 5; ++j) cache->put(disk_key(j), "kill", disk_tile(j));
        cache->flush();
        if (!cache->stats().is_writable) ::_exit(3);
        if (::write(ends[1], &i, sizeof i) != sizeof i) ::_exit(4);
      }
      ::pause();
    }
    ::close(ends[1]);
    // Every other child is killed some time after its first acknowledgement, the others whatever they are doing, opening included.
    if (round % 2 == 0) {
      pollfd first_ack{ends[0], POLLIN, 0};
      ASSERT_EQ(::poll(&first_ack, 1, 30000), 1) << "round " << round << ": nothing acknowledged in 30 s";
    }
    std::this_thread::sleep_for(std::chrono::microseconds(500 + random() % 15000));
    ASSERT_EQ(::kill(child, SIGKILL), 0);
    int status = 0;
    ASSERT_EQ(::waitpid(child, &status, 0), child);
    ASSERT_TRUE(WIFSIGNALED(status)) << "round " << round << ": the writer ended by itself with " << WEXITSTATUS(status);
    std::uint64_t batch = 0;
    while (::read(ends[0], &batch, sizeof batch) == sizeof batch) {
      for (std::uint64_t j = batch; j < batch + 5; ++j) acknowledged.insert(j);
    }
    ::close(ends[0]);

    const auto cache = DiskCache::open(options(512 * kMiB));
    ASSERT_TRUE(cache->stats().is_writable) << cache->stats().last_error;
    for (const std::uint64_t number : acknowledged) {
      if (number < first && round % 10 != 9) continue;  // the old ones every tenth time
      ASSERT_EQ(count_right(*cache, number, 1), 1u) << "round " << round << ", tile " << number << ": "
                                                       << cache->stats().last_error;
    }
    count_right(*cache, first, 400);
    EXPECT_EQ(cache->stats().corrupt, 0u);
  }
  EXPECT_GE(acknowledged.size(), 25u * 5);  // however slow the machine
}

// A file that was flipped while nobody had it open: each flip alone, so that each place counts.
TEST_F(DiskCacheFaults, ServesNoWrongByteAfterABitFlipAtRest) {
  { fill(*DiskCache::open(options(2 * kMiB)), 0, 60); }
  const std::string good = data_bytes();
  ASSERT_GT(good.size(), 100000u);
  std::mt19937_64 random(1);
  std::uint64_t lost = 0, noticed = 0;
  for (int round = 0; round < 1000; ++round) {
    // Every other flip goes into the first pages: metas, tree roots and the like.
    const std::uint64_t at = random() % (round % 2 ? 65536 : good.size());
    std::string bad = good;
    bad[at] ^= static_cast<char>(1 << random() % 8);
    write_data(bad);
    const auto cache = DiskCache::open(options(2 * kMiB));
    ASSERT_TRUE(cache->stats().is_writable) << "byte " << at << ": " << cache->stats().last_error;
    const std::uint64_t right = count_right(*cache, 0, 60);
    ASSERT_FALSE(HasFailure()) << "byte " << at;
    lost += right < 60;
    noticed += right < 60 && cache->stats().corrupt > 0;
    // It heals: what was lost can be written again.
    fill(*cache, 0, 60);
    ASSERT_EQ(count_right(*cache, 0, 60), 60u) << "byte " << at << ": " << cache->stats().last_error;
  }
  EXPECT_GT(lost, 300u);
  EXPECT_EQ(noticed, lost);
}

TEST_F(DiskCacheFaults, ServesNoWrongByteWhileBitsFlipUnderIt) {
  const auto cache = DiskCache::open(options(4 * kMiB));
  fill(*cache, 0, 400);
  std::mt19937_64 random(2);
  for (int round = 0; round < 1000; ++round) {
    std::error_code failure;  // the writer may be putting a new file in place right now
    const std::uint64_t size = std::filesystem::file_size(data_file(), failure);
    if (!failure && size > 0) flip(random() % size, random() % 8);
    const std::uint64_t number = random() % 400;
    cache->put(disk_key(number), "t", disk_tile(number));
    if (round % 10 == 9) {
      count_right(*cache, 0, 400);
      fill(*cache, 0, 400);
    }
    ASSERT_FALSE(HasFailure()) << "round " << round;
  }
  EXPECT_GT(cache->stats().corrupt, 300u);
  // The next walk over the structure finds what is still hidden; then everything works again.
  std::this_thread::sleep_for(1500ms);
  count_right(*cache, 0, 400);
  fill(*cache, 0, 400);
  EXPECT_GT(count_right(*cache, 0, 400), 390u) << cache->stats().last_error;
}

TEST_F(DiskCacheFaults, RemovesACorruptEntryAndTakesItAgain) {
  const auto cache = DiskCache::open(options());
  fill(*cache, 3, 1);  // 20 KB
  const std::string bytes = data_bytes();
  const std::size_t at = bytes.find(disk_tile(3)->body.substr(5000, 64));
  ASSERT_NE(at, std::string::npos);
  flip(at, 3);
  EXPECT_EQ(cache->get(disk_key(3)), nullptr);
  EXPECT_EQ(cache->stats().corrupt, 1u);
  cache->flush();
  EXPECT_EQ(cache->stats().entries, 0u);
  fill(*cache, 3, 1);
  EXPECT_EQ(count_right(*cache, 3, 1), 1u);
  EXPECT_EQ(cache->stats().corrupt, 1u);
}

TEST_F(DiskCacheFaults, VerifyFindsAndRepairsCorruptEntries) {
  EXPECT_EQ(verify_disk_cache(directory(), false).error().code, ErrorCode::kNotFound);
  { fill(*DiskCache::open(options()), 0, 50); }
  const std::size_t at = data_bytes().find(disk_tile(10)->body.substr(5000, 64));
  ASSERT_NE(at, std::string::npos);
  flip(at, 0);
  for (const bool repair : {false, true, true}) {
    static int run = 0;
    const Result<DiskCacheReport> report = verify_disk_cache(directory(), repair);
    ASSERT_TRUE(report) << report.error().message;
    EXPECT_EQ(report->entries, 49u);
    EXPECT_EQ(report->corrupt, run < 2 ? 1u : 0u) << "run " << run;
    ++run;
  }
  EXPECT_EQ(count_right(*DiskCache::open(options()), 0, 50), 49u);
  write_data("not a database");
  EXPECT_EQ(verify_disk_cache(directory(), false)->corrupt, 1u);
  EXPECT_EQ(data_bytes(), "not a database");
  EXPECT_EQ(verify_disk_cache(directory(), true)->corrupt, 1u);
  EXPECT_EQ(verify_disk_cache(directory(), false)->corrupt, 0u);
}

TEST_F(DiskCacheFaults, VerifyLeavesAFileOfAnotherVersionAloneUnlessItRepairs) {
  { fill(*DiskCache::open(options()), 0, 20); }
  std::string other = data_bytes();
  const std::string old_version = std::string("format") + std::string("\1\0\0\0", 4);
  int changed = 0;
  for (std::size_t at = other.find(old_version); at != std::string::npos; at = other.find(old_version, at + 1), ++changed) other[at + 6] = 2;
  ASSERT_GT(changed, 0);
  write_data(other);
  EXPECT_EQ(verify_disk_cache(directory(), false)->corrupt, 1u);
  EXPECT_TRUE(data_bytes() == other);
  EXPECT_TRUE(verify_disk_cache(directory(), true));
  EXPECT_EQ(count_right(*DiskCache::open(options()), 0, 20), 0u);
}

TEST_F(DiskCacheFaults, StartsAnewFromGarbageAndCutFiles) {
  { fill(*DiskCache::open(options(2 * kMiB)), 0, 60); }
  const std::string good = data_bytes();
  std::vector<std::string> bad = {std::string(100, 'x'), std::string(8192, '\0'), std::string(100000, '\xff')};
  std::mt19937_64 random(3);
  for (const std::size_t size : {std::size_t{1}, std::size_t{4095}, std::size_t{4096}, std::size_t{8192}, std::size_t{12288}, good.size() / 2, good.size() - 4096}) {
    bad.push_back(good.substr(0, size));
  }
  for (int i = 0; i < 60; ++i) bad.push_back(good.substr(0, random() % good.size()));
  for (const std::string& bytes : bad) {
    write_data(bytes);
    const auto cache = DiskCache::open(options(2 * kMiB));
    ASSERT_TRUE(cache->stats().is_writable) << bytes.size() << " bytes: " << cache->stats().last_error;
    // Right unless the part that was cut off was free.
    EXPECT_TRUE(count_right(*cache, 0, 60) == 60 || cache->stats().corrupt > 0) << bytes.size() << " bytes";
    fill(*cache, 0, 60);
    EXPECT_EQ(count_right(*cache, 0, 60), 60u);
  }
}

TEST_F(DiskCacheFaults, OutlivesAFileCutShortWhileOpen) {
  const auto cache = DiskCache::open(options());
  fill(*cache, 0, 300);
  ASSERT_EQ(::truncate(data_file().c_str(), 40000), 0);
  EXPECT_LT(count_right(*cache, 0, 300), 300u);
  fill(*cache, 1000, 100);
  ASSERT_TRUE(wait_for([&] { fill(*cache, 1000, 100); return count_right(*cache, 1000, 100) == 100; })) << cache->stats().last_error;
  EXPECT_GT(cache->stats().corrupt, 0u);
}

TEST_F(DiskCacheFaults, OutlivesItsDirectory) {
  const auto cache = DiskCache::open(options());
  fill(*cache, 0, 50);
  std::filesystem::remove_all(directory());
  ASSERT_TRUE(wait_for([&] { fill(*cache, 100, 50); return std::filesystem::exists(data_file()); })) << cache->stats().last_error;
  fill(*cache, 200, 50);
  EXPECT_EQ(count_right(*cache, 200, 50), 50u);
  // A file where the directory was: nothing to be done until it goes away.
  std::filesystem::remove_all(directory());
  std::ofstream(directory()) << "in the way";
  ASSERT_TRUE(wait_for([&] { return !cache->stats().is_writable; }));
  EXPECT_FALSE(cache->stats().last_error.empty());
  EXPECT_EQ(cache->get(disk_key(200)), nullptr);
  cache->put(disk_key(1), "a", disk_tile(1));
  cache->flush();
  std::filesystem::remove(directory());
  ASSERT_TRUE(wait_for([&] { return cache->stats().is_writable; })) << cache->stats().last_error;
  fill(*cache, 300, 50);
  EXPECT_EQ(count_right(*cache, 300, 50), 50u);
}

TEST_F(DiskCacheFaults, OpensOnAPathThatCannotBe) {
  std::ofstream(root_ / "file") << "a regular file";
  DiskCacheOptions bad = options();
  bad.directory = root_ / "file" / "cache";
  const auto cache = DiskCache::open(bad);
  EXPECT_FALSE(cache->stats().is_writable);
  EXPECT_NE(cache->stats().last_error.find("file/cache"), std::string::npos) << cache->stats().last_error;
  fill(*cache, 0, 10);
  EXPECT_EQ(cache->get(disk_key(1)), nullptr);
  EXPECT_EQ(cache->stats().dropped_writes, 10u);
  EXPECT_FALSE(cache->purge("a"));
  std::filesystem::remove(root_ / "file");
  ASSERT_TRUE(wait_for([&] { return cache->stats().is_writable; })) << cache->stats().last_error;
  fill(*cache, 0, 10);
  EXPECT_EQ(count_right(*cache, 0, 10), 10u);
}

// A small tmpfs where that is allowed (root); else a limit on the size of files. `is_tmpfs` tells which.
class SmallDisk {
 public:
  explicit SmallDisk(const std::filesystem::path& at) : at_(at) {
    std::filesystem::create_directories(at);
    is_tmpfs_ = ::mount("tmpfs", at.c_str(), "tmpfs", 0, "size=2m") == 0;
    ::signal(SIGXFSZ, SIG_IGN);
    if (!is_tmpfs_) limit(2 * kMiB);
  }
  ~SmallDisk() {
    grow();
    if (is_tmpfs_) ::umount2(at_.c_str(), MNT_DETACH);
  }
  void grow() { is_tmpfs_ ? (void)::mount("tmpfs", at_.c_str(), "tmpfs", MS_REMOUNT, "size=64m") : limit(RLIM_INFINITY); }
  bool set_read_only(bool is_read_only) {
    return is_tmpfs_ && ::mount("tmpfs", at_.c_str(), "tmpfs", MS_REMOUNT | (is_read_only ? MS_RDONLY : 0), "size=2m") == 0;
  }
  bool is_tmpfs() const { return is_tmpfs_; }

 private:
  static void limit(rlim_t bytes) {
    rlimit now{};
    ::getrlimit(RLIMIT_FSIZE, &now);
    now.rlim_cur = std::min(bytes, now.rlim_max);
    ::setrlimit(RLIMIT_FSIZE, &now);
  }
  std::filesystem::path at_;
  bool is_tmpfs_ = false;
};

TEST_F(DiskCacheFaults, LivesOnAFullDiskAndRecovers) {
  SmallDisk disk(root_ / "disk");
  DiskCacheOptions here = options(32 * kMiB);
  here.directory = root_ / "disk" / "cache";
  const auto cache = DiskCache::open(here);
  ASSERT_TRUE(cache->stats().is_writable) << cache->stats().last_error;
  fill(*cache, 0, 60);
  EXPECT_EQ(count_right(*cache, 0, 60), 60u);
  for (int i = 0; i < 20 && cache->stats().is_writable; ++i) fill(*cache, 1000 + 100 * i, 100);
  DiskCache::Stats stats = cache->stats();
  EXPECT_FALSE(stats.is_writable);
  EXPECT_GT(stats.write_errors, 0u);
  EXPECT_GT(stats.dropped_writes, 0u);
  EXPECT_FALSE(stats.last_error.empty());
  EXPECT_EQ(count_right(*cache, 0, 60), 60u);  // what is there is still served
  count_right(*cache, 1000, 2000);
  disk.grow();
  std::uint64_t next = 10000;
  ASSERT_TRUE(wait_for([&] { fill(*cache, next += 10, 10); return cache->stats().is_writable; })) << cache->stats().last_error;
  fill(*cache, 20000, 200);
  EXPECT_EQ(count_right(*cache, 20000, 200), 200u);
  EXPECT_EQ(count_right(*cache, 0, 60), 60u);
  EXPECT_EQ(cache->stats().corrupt, 0u);
}

TEST_F(DiskCacheFaults, StartsOnAFullDiskAndRecovers) {
  SmallDisk disk(root_ / "disk");
  const std::filesystem::path filler = root_ / "disk" / "filler";
  DiskCacheOptions here = options();
  here.directory = root_ / "disk" / "cache";
  if (disk.is_tmpfs()) {
    std::ofstream out(filler, std::ios::binary);
    out << std::string(4 * kMiB, 'f');
  } else {
    rlimit none{};
    ::getrlimit(RLIMIT_FSIZE, &none);
    none.rlim_cur = 100;
    ::setrlimit(RLIMIT_FSIZE, &none);
  }
  const auto cache = DiskCache::open(here);
  EXPECT_FALSE(cache->stats().is_writable);
  EXPECT_FALSE(cache->stats().last_error.empty());
  fill(*cache, 0, 10);
  EXPECT_EQ(cache->get(disk_key(0)), nullptr);
  std::filesystem::remove(filler);
  disk.grow();
  ASSERT_TRUE(wait_for([&] { return cache->stats().is_writable; })) << cache->stats().last_error;
  fill(*cache, 0, 50);
  EXPECT_EQ(count_right(*cache, 0, 50), 50u);
}

// Root ignores permission bits, so root gets a read-only mount and others a directory without write permission.
TEST_F(DiskCacheFaults, StartsOnAReadOnlyDirectoryAndRecovers) {
  SmallDisk disk(root_ / "disk");
  DiskCacheOptions here = options();
  here.directory = root_ / "disk" / "cache";
  { fill(*DiskCache::open(here), 0, 20); }
  const bool is_remounted = disk.set_read_only(true);
  if (!is_remounted) {
    // Neither mounts nor (for a caged root) permission bits: a file in the directory's place refuses everybody.
    std::filesystem::rename(here.directory, root_ / "away");
    std::ofstream(here.directory) << "in the way";
  }
  const auto cache = DiskCache::open(here);
  EXPECT_FALSE(cache->stats().is_writable);
  EXPECT_FALSE(cache->stats().last_error.empty());
  fill(*cache, 100, 10);
  EXPECT_EQ(cache->stats().dropped_writes, 10u);
  EXPECT_EQ(count_right(*cache, 100, 10), 0u);
  if (is_remounted) {
    ASSERT_TRUE(disk.set_read_only(false));
  } else {
    std::filesystem::remove(here.directory);
    std::filesystem::rename(root_ / "away", here.directory);
  }
  ASSERT_TRUE(wait_for([&] { return cache->stats().is_writable; })) << cache->stats().last_error;
  EXPECT_EQ(count_right(*cache, 0, 20), 20u);
  fill(*cache, 100, 10);
  EXPECT_EQ(count_right(*cache, 100, 10), 10u);
}

}  // namespace
}  // namespace lodestone

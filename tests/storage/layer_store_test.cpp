// LayerStore: windows, mirrors, damage, crashes, two writers.

#include "storage/dem/layer_store.h"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <csignal>
#include <thread>

#include "tests/support/rasters.h"

namespace lodestone {
namespace {

using ::testing::HasSubstr;
using testing::hills;
using testing::ingest_and_open;
using testing::options_for;
using testing::RasterSpec;
using testing::real_kernels;
using testing::Scratch;
using testing::write_raster;

TEST(LayerStore, MirrorsBeyondTheWorldAndClampsFarAway) {
  const Scratch scratch;
  write_raster(scratch / "a.tif", {300, 270}, [](int i, int j, int) { return hills(i, j); });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  for (const PostWindow w :
       {PostWindow{-5, -7, 10, 10}, {290, 260, 310, 280}, {-900, 100, -880, 101}, {250, -3, 260, 275}}) {
    auto grid = (*store)->read_window((*store)->info().base_level, w);
    ASSERT_TRUE(grid) << grid.error().message;
    for (std::int64_t j = w.j0; j <= w.j1; ++j) {
      for (std::int64_t i = w.i0; i <= w.i1; ++i) {
        ASSERT_EQ(grid->at(i, j), static_cast<float>(hills(static_cast<int>(mirrored(i, 0, 299)),
                                                           static_cast<int>(mirrored(j, 0, 269)))))
            << i << "," << j;
      }
    }
  }
  EXPECT_EQ((*store)->read_window((*store)->info().base_level + 1, {0, 0, 1, 1}).error().code,
            ErrorCode::kNotFound);
  EXPECT_EQ((*store)->read_window(0, {0, 0, 1 << 20, 1 << 20}).error().code, ErrorCode::kTooLarge);
}

TEST(LayerStore, NamesTheLayersThatExist) {
  const Scratch scratch;
  auto none = LayerStore::open(scratch.path(), "a");
  ASSERT_FALSE(none);
  EXPECT_EQ(none.error().code, ErrorCode::kNotFound);
  write_raster(scratch / "a.tif", {30, 30}, [](int i, int j, int) { return hills(i, j); });
  ASSERT_TRUE(ingest_and_open(scratch.path(), options_for("alps", {scratch / "a.tif"})));
  std::filesystem::create_directories(scratch.path() / "layers" / "unfinished");
  EXPECT_THAT(list_layers(scratch.path()), ::testing::ElementsAre("alps"));
  EXPECT_THAT(LayerStore::open(scratch.path(), "andes").error().message, HasSubstr("alps"));
  EXPECT_EQ(LayerStore::open(scratch.path(), "../alps").error().code, ErrorCode::kInvalidArgument);
}

TEST(LayerStore, ReadsFromManyThreads) {
  const Scratch scratch;
  write_raster(scratch / "a.tif", {600, 600}, [](int i, int j, int) { return hills(i, j); });
  ASSERT_TRUE(ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"})));
  auto store =
      LayerStore::open(scratch.path(), "a", 300'000);  // about one tile: everything is evicted all the time
  ASSERT_TRUE(store);
  std::atomic<int> wrong{0};
  std::vector<std::thread> threads;
  for (int t = 0; t < 8; ++t) {
    threads.emplace_back([&, t] {
      for (int n = 0; n < 40; ++n) {
        const std::int64_t i = (n * 97 + t * 31) % 500, j = (n * 53 + t * 71) % 500;
        auto grid = (*store)->read_window((*store)->info().base_level, {i, j, i + 99, j + 99});
        if (!grid || grid->at(i + 50, j + 70) !=
                         static_cast<float>(hills(static_cast<int>(i) + 50, static_cast<int>(j) + 70)))
          ++wrong;
      }
    });
  }
  for (std::thread& t : threads) t.join();
  EXPECT_EQ(wrong, 0);
}

// Flips one bit at a time in the stored file: a wrong height is never returned.
TEST(LayerStore, NeverServesFlippedBits) {
  const Scratch scratch;
  RasterSpec spec{400, 300};
  spec.nodata = -1;
  write_raster(scratch / "a.tif", spec, [](int i, int j, int) { return i + j < 90 ? -1 : hills(i, j); });
  HeightGrid truth;
  std::filesystem::path file;
  {
    auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
    ASSERT_TRUE(store);
    truth = *(*store)->read_window((*store)->info().base_level, (*store)->info().world);
    for (const auto& entry : std::filesystem::recursive_directory_iterator(scratch.path() / "layers" / "a")) {
      if (entry.path().filename() == "data.mdb") file = entry.path();
    }
  }
  const auto bytes = static_cast<std::int64_t>(std::filesystem::file_size(file));
  const int fd = ::open(file.c_str(), O_RDWR);
  ASSERT_GE(fd, 0);
  std::uint32_t random = 7;
  int detected = 0, reported = 0;
  for (int n = 0; n < 300; ++n) {
    random = random * 1664525U + 1013904223U;
    const auto at = static_cast<off_t>(random) % bytes;
    unsigned char byte = 0;
    ASSERT_EQ(::pread(fd, &byte, 1, at), 1);
    const auto flipped = static_cast<unsigned char>(byte ^ (1U << n % 8));
    ASSERT_EQ(::pwrite(fd, &flipped, 1, at), 1);
    auto store = LayerStore::open(scratch.path(), "a");
    if (!store) {
      ++detected;
    } else {
      auto grid = (*store)->read_window((*store)->info().base_level, (*store)->info().world);
      if (!grid) {
        EXPECT_EQ(grid.error().code, ErrorCode::kCorrupt) << grid.error().message;
        EXPECT_GE((*store)->corrupt_values(), 1U);
        ++detected;
      } else {
        ASSERT_EQ(grid->heights_m, truth.heights_m) << "byte " << at;
        ASSERT_EQ(grid->is_void, truth.is_void) << "byte " << at;
      }
      auto report = verify_layer(scratch.path(), "a", nullptr);
      reported += report && !report->problems.empty() ? 1 : 0;
    }
    ASSERT_EQ(::pwrite(fd, &byte, 1, at), 1);
  }
  ::close(fd);
  EXPECT_GT(detected, 50);
  EXPECT_GT(reported, 50);
  // Cut short: said at once.
  std::filesystem::resize_file(file, static_cast<std::uintmax_t>(bytes / 2));
  auto cut = LayerStore::open(scratch.path(), "a");
  ASSERT_FALSE(cut);
  EXPECT_EQ(cut.error().code, ErrorCode::kCorrupt);
}

TEST(LayerStore, SurvivesAKillDuringIngest) {
  const Scratch scratch;
  RasterSpec spec{1100, 1000};
  spec.nodata = -1;
  const auto write = [&](const std::string& name, int add) {
    write_raster(scratch / name, spec,
                 [add](int i, int j, int) { return (i / 200 + j / 150) % 3 == 0 ? -1 : hills(i, j) + add; });
  };
  write("old.tif", 0);
  write("new.tif", 1000);
  auto first = ingest(scratch.path(), options_for("a", {scratch / "old.tif"}), real_kernels(), nullptr);
  ASSERT_TRUE(first) << first.error().message;
  int killed = 0;
  for (int round = 0; round < 12; ++round) {
    const pid_t child = ::fork();
    if (child == 0) {
      // No other thread of ours runs at this moment: the copy may ingest.
      const auto info =
          ingest(scratch.path(), options_for("a", {scratch / "new.tif"}), real_kernels(), nullptr);
      ::_exit(info ? 0 : 9);
    }
    ::usleep(static_cast<useconds_t>(20'000 + round * 25'000));
    ::kill(child, SIGKILL);
    int status = 0;
    ::waitpid(child, &status, 0);
    killed += WIFSIGNALED(status) ? 1 : 0;
    auto store = LayerStore::open(scratch.path(), "a");
    ASSERT_TRUE(store) << store.error().message;
    auto report = verify_layer(scratch.path(), "a", nullptr);
    ASSERT_TRUE(report);
    EXPECT_THAT(report->problems, ::testing::IsEmpty());
  }
  EXPECT_GT(killed, 0);
  // What was left does not disturb the next one, and is swept.
  auto again = ingest(scratch.path(), options_for("a", {scratch / "new.tif"}), real_kernels(), nullptr);
  ASSERT_TRUE(again) << again.error().message;
  EXPECT_EQ(again->height_max_m, first->height_max_m + 1000);
  int generations = 0;
  for (const auto& entry : std::filesystem::directory_iterator(scratch.path() / "layers" / "a")) {
    generations += entry.path().filename().string().rfind("gen-", 0) == 0 ? 1 : 0;
  }
  EXPECT_EQ(generations, 1);
}

TEST(LayerStore, AllowsOneWriterAndKeepsOldReaders) {
  const Scratch scratch;
  write_raster(scratch / "a.tif", {300, 300}, [](int i, int j, int) { return hills(i, j); });
  write_raster(scratch / "b.tif", {300, 300}, [](int i, int j, int) { return hills(i, j) + 500; });
  auto old = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(old);
  {
    auto lock = FileLock::acquire(scratch.path() / "layers" / "a" / "lock", "layer a");
    ASSERT_TRUE(lock);
    auto refused = ingest(scratch.path(), options_for("a", {scratch / "b.tif"}), real_kernels(), nullptr);
    ASSERT_FALSE(refused);
    EXPECT_EQ(refused.error().code, ErrorCode::kConflict);
  }
  auto now = ingest_and_open(scratch.path(), options_for("a", {scratch / "b.tif"}));
  ASSERT_TRUE(now);
  EXPECT_EQ((*old)->read_window(1, {5, 5, 5, 5})->at(5, 5), static_cast<float>(hills(5, 5)));
  EXPECT_EQ((*now)->read_window(1, {5, 5, 5, 5})->at(5, 5), static_cast<float>(hills(5, 5) + 500));
  EXPECT_NE((*old)->info().source_digest, (*now)->info().source_digest);
}

TEST(LayerStore, KeepsWhatTheFinishHookLeaves) {
  const Scratch scratch;
  write_raster(scratch / "a.tif", {300, 300}, [](int i, int j, int) { return hills(i, j); });
  IngestKernels kernels = real_kernels();
  kernels.finish = [](const LayerStore& store) -> Result<std::string> {
    auto grid = store.read_window(store.info().base_level, {0, 0, 3, 3});
    if (!grid) return grid.error();
    return "{\"corner\": " + std::to_string(grid->at(3, 3)) +
           ", \"levels\": " + std::to_string(store.info().variances.size()) + "}";
  };
  ASSERT_TRUE(ingest(scratch.path(), options_for("a", {scratch / "a.tif"}), kernels, nullptr));
  auto store = LayerStore::open(scratch.path(), "a");
  ASSERT_TRUE(store);
  EXPECT_THAT((*store)->roughness_json(), HasSubstr("\"levels\": 8"));
  // A hook that fails leaves the old layer.
  kernels.finish = [](const LayerStore&) -> Result<std::string> { return Error{ErrorCode::kInternal, "no"}; };
  EXPECT_FALSE(ingest(scratch.path(), options_for("a", {scratch / "a.tif"}), kernels, nullptr));
  EXPECT_TRUE(LayerStore::open(scratch.path(), "a"));
}

}  // namespace
}  // namespace lodestone

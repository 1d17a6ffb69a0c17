// Opening devices: choice, kept binaries, work-group sizes.

#include "kernels/device/device.h"

#include <gtest/gtest.h>

#include <map>

#include "tests/support/wavelet_run.h"

namespace lodestone {
namespace {

TEST(Device, IsFoundByPartsOfItsName) {
  ASSERT_NE(testing::test_device(), nullptr);
  const DeviceDescription& d = testing::test_device()->description();
  EXPECT_GT(d.compute_units, 0);
  EXPECT_GE(d.max_work_group, 64);
  EXPECT_FALSE(list_devices().empty());
  DeviceOptions options;
  options.name = "no such device";
  Result<std::shared_ptr<Device>> none = Device::open(options);
  ASSERT_FALSE(none);
  EXPECT_EQ(none.error().code, ErrorCode::kNotFound);
  EXPECT_NE(none.error().message.find(d.name), std::string::npos) << none.error().message;
}

TEST(Device, RefusesAbsurdWorkGroups) {
  ASSERT_NE(testing::test_device(), nullptr);
  DeviceOptions options;
  options.local_size = 0;
  Result<std::shared_ptr<Device>> opened = Device::open(options);
  ASSERT_FALSE(opened);
  EXPECT_EQ(opened.error().code, ErrorCode::kInvalidArgument);
}

TEST(Device, GivesTheSameBitsWhateverTheWorkGroup) {
  testing::World world = testing::make_world(0, 0, 33, 33, 21);
  testing::add_mask(world, 1, 2, 0);
  for (const int local : {1, 128, 256}) {
    auto device = testing::open_test_device(local);
    ASSERT_TRUE(device) << device.error().message;
    auto synthesis = make_device_wavelet_synthesis(*device);
    ASSERT_TRUE(synthesis) << synthesis.error().message;
    for (const WaveletMethod method : {WaveletMethod::kGsa, WaveletMethod::kLsa}) {
      const WaveletTask task = testing::task_over(world, method, 3, 129, 128, 0);
      EXPECT_EQ(testing::bits(testing::run_on(**synthesis, task)), testing::bits(testing::run_both(task))) << local;
    }
  }
}

TEST(Device, KeepsBinariesAndSurvivesBadOnes) {
  ASSERT_NE(testing::test_device(), nullptr);
  const testing::World world = testing::make_world(0, 0, 17, 17, 22);
  const WaveletTask task = testing::task_over(world, WaveletMethod::kLsa, 3, 65);
  const std::vector<float> expected = testing::run_both(task);
  std::map<std::string, std::string> kept;
  int saved = 0;
  DeviceOptions options;
  options.load_binary = [&](const std::string& key) { return kept.contains(key) ? kept[key] : std::string(); };
  options.save_binary = [&](const std::string& key, const std::string& bytes) {
    ++saved;
    kept[key] = bytes;
  };
  const auto check = [&](const char* what) {
    auto device = Device::open(options);
    ASSERT_TRUE(device) << what << ": " << device.error().message;
    auto synthesis = make_device_wavelet_synthesis(*device);
    ASSERT_TRUE(synthesis) << what;
    EXPECT_EQ(testing::bits(testing::run_on(**synthesis, task)), testing::bits(expected)) << what;
  };
  check("from source");
  const int programs = saved;
  EXPECT_EQ(programs, 3);  // self-test, details, lifting: those that have been launched
  check("from binaries");
  EXPECT_EQ(saved, programs) << "kept binaries were not used";
  for (auto& [key, bytes] : kept) bytes[bytes.size() / 2] = static_cast<char>(bytes[bytes.size() / 2] ^ 0x40);
  check("flipped bit");
  EXPECT_EQ(saved, 2 * programs);
  for (auto& [key, bytes] : kept) bytes.resize(bytes.size() / 3);
  check("cut short");
  for (auto& [key, bytes] : kept) bytes = "not a program";
  check("other bytes");
  EXPECT_EQ(saved, 4 * programs);
}

TEST(Device, HasAStableSourceHash) {
  EXPECT_NE(kernel_source_hash(), 0u);
  EXPECT_EQ(kernel_source_hash(), kernel_source_hash());
}

}  // namespace
}  // namespace lodestone

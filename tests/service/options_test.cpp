#include "service/config/options.h"

#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <sstream>

namespace lodestone {
namespace {

class OptionsFile : public ::testing::Test {
 protected:
  Result<Options> load(const std::string& text, const std::vector<std::pair<std::string, std::string>>& flags = {}) {
    const std::string path = ::testing::TempDir() + "/lodestone_options_test.toml";
    std::ofstream(path) << text;
    return load_options(path, flags);
  }
};

TEST_F(OptionsFile, FlagsBeatTheEnvironmentWhichBeatsTheFile) {
  ::setenv("LODESTONE_QUEUE_TILES", "20", 1);
  ::setenv("LODESTONE_WORKERS", "7", 1);
  const auto options = load("queue_tiles = 10\nworkers = 3\nbatch_tiles = 5\n", {{"queue_tiles", "30"}});
  ::unsetenv("LODESTONE_QUEUE_TILES");
  ::unsetenv("LODESTONE_WORKERS");
  ASSERT_TRUE(options) << options.error().message;
  EXPECT_EQ(options->queue_tiles, 30);
  EXPECT_EQ(options->workers, 7);
  EXPECT_EQ(options->batch_tiles, 5);
}

TEST_F(OptionsFile, UnknownKeysAreErrorsWithPlaceAndSuggestion) {
  const auto options = load("\nqueue_tile = 10\n");
  ASSERT_FALSE(options);
  EXPECT_NE(options.error().message.find(":2:"), std::string::npos) << options.error().message;
  EXPECT_NE(options.error().message.find("queue_tiles"), std::string::npos) << options.error().message;
}

TEST_F(OptionsFile, ValuesOutsideTheirRangeNameTheRange) {
  const auto options = load("batch_tiles = 65\n");
  ASSERT_FALSE(options);
  EXPECT_NE(options.error().message.find("1..64"), std::string::npos) << options.error().message;
  for (const char* text : {"batch_tiles = \"many\"\n", "[batch_tiles]\na = 1\n", "log_level = \"loud\"\n", "batch_tiles = \n"}) {
    EXPECT_FALSE(load(text)) << text;
  }
}

TEST_F(OptionsFile, RecipesChangeOrAddAndKeepTheFixedOnes) {
  const auto options = load(
      "[recipes.mountain]\nmethod = \"lsa\"\nseed = 42\nwindow = 5\nmasks = [\"roads\", \"rivers\"]\nmask_mode = \"protect\"\n"
      "[recipes.gsa]\nfit = \"paper\"\n");
  ASSERT_TRUE(options) << options.error().message;
  for (const char* name : {"linear", "gsa", "lsa", "square-square", "diamond-square", "fractal-wavelet", "mountain"}) {
    EXPECT_EQ(options->recipes.count(name), 1U) << name;
  }
  const Recipe& mountain = options->recipes.at("mountain");
  EXPECT_EQ(mountain.method, Method::kLsa);
  EXPECT_EQ(mountain.seed, 42U);
  EXPECT_EQ(mountain.lsa.window, 5);
  EXPECT_EQ(mountain.masks, (std::vector<std::string>{"roads", "rivers"}));
  EXPECT_EQ(mountain.mask_mode, MaskMode::kProtect);
  EXPECT_EQ(options->recipes.at("gsa").lsa.fit, FitWeights::kPaper);
}

TEST_F(OptionsFile, BadRecipesNameTheParameterAndWhatIsAllowed) {
  for (const char* text :
       {"[recipes.a]\nwindow = 4\n", "[recipes.a]\ntrust = 2.0\n", "[recipes.a]\nmethod = \"magic\"\n",
        "[recipes.a]\nwindows = 3\n", "[recipes.a]\nmasks = \"roads\"\n", "[recipes.a]\naltitude = [1.0, 2.0]\n",
        "[recipes.a]\nquantum = 0.3\n", "[recipes.a]\nseed = -1\n", "[recipes.\"a/b\"]\nseed = 1\n", "[recipes]\na = 1\n"}) {
    EXPECT_FALSE(load(text)) << text;
  }
  const auto options = load("[recipes.a]\nwindow = 4\n");
  EXPECT_NE(options.error().message.find("1, 3, 5, 7"), std::string::npos) << options.error().message;
}

TEST_F(OptionsFile, ADumpReadsBackAsTheSameConfiguration) {
  const auto options = load(
      "listen = \"127.0.0.1:9\"\n[recipes.m]\nmethod = \"fractal-wavelet\"\nwater = 3.5\ncap = 2.0\n"
      "altitude = [0.0, 100.0, 0.5, 2.0]\nquantum = 0.25\n");
  ASSERT_TRUE(options) << options.error().message;
  const std::string dump = dump_options(*options, false);
  const auto again = load(dump);
  ASSERT_TRUE(again) << again.error().message << "\n" << dump;
  EXPECT_EQ(dump_options(*again, false), dump);
}

TEST(Options, TheCommittedDefaultsAreWhatTheProgramPrints) {
  std::ifstream file(LODESTONE_SOURCE_DIR "/config/lodestone.toml");
  std::stringstream text;
  text << file.rdbuf();
  EXPECT_EQ(text.str(), dump_options(Options{}, true))
      << "write it anew: lodestone config dump --comments > config/lodestone.toml";
}

TEST(Options, SeedsAreAnyUint64) {
  EXPECT_EQ(*parse_seed("18446744073709551615"), 18446744073709551615ULL);
  EXPECT_EQ(*parse_seed("0"), 0U);
  for (const char* text : {"", "-1", "+1", "1.0", "0x10", "18446744073709551616", "1 ", "one"}) {
    EXPECT_FALSE(parse_seed(text)) << text;
  }
}

TEST(Options, TheNearestNameIsSuggested) {
  EXPECT_EQ(nearest_name("wrkers", {"workers", "queue_tiles"}), "workers");
  EXPECT_EQ(nearest_name("zzzzzzzzz", {"workers", "queue_tiles"}), "");
}

}  // namespace
}  // namespace lodestone

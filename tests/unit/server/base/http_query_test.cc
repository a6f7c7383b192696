#include "server/base/http_query.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

TEST(HttpQueryTest, HoldsParameters) {
  const auto query =
      HttpQuery::Parse({{"limit", "20"}, {"empty", ""}}, {"filter", "limit", "empty"});
  ASSERT_TRUE(query.ok()) << query.status();
  EXPECT_EQ(query->Get("empty", "otherwise"), "");
  EXPECT_EQ(query->Get("absent", "otherwise"), "otherwise");
  EXPECT_EQ(query->GetInteger("limit", 50, 1, 100).value(), 20);
  EXPECT_EQ(query->GetInteger("absent", 50, 1, 100).value(), 50);
  EXPECT_TRUE(HttpQuery::Parse({}, {}).ok());
}

TEST(HttpQueryTest, SaysWhatIsWrong) {
  const auto message = [](const absl::Status& status) {
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    return std::string(status.message());
  };
  EXPECT_THAT(message(HttpQuery::Parse({{"fliter", "a"}}, {"filter"}).status()),
              HasSubstr("expected parameters among filter, received \"fliter\""));
  EXPECT_THAT(message(HttpQuery::Parse({{"filter", "a"}, {"filter", "b"}}, {"filter"}).status()),
              HasSubstr("filter: expected once"));
  for (const std::string wrong : {"0", "101", "1e2", "", "99999999999999999999"}) {
    const auto query = HttpQuery::Parse({{"limit", wrong}}, {"limit"});
    ASSERT_TRUE(query.ok());
    EXPECT_THAT(message(query->GetInteger("limit", 50, 1, 100).status()),
                HasSubstr("limit: expected a whole number from 1 to 100, received \"" + wrong));
  }
}

}  // namespace
}  // namespace spikeserve

#include "server/options.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "server/base/address.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

TEST(AddressTest, HostAndPort) {
  for (const std::string text :
       {"127.0.0.1:0", "localhost:50051", "[::1]:65535", "my-host.example.org:1"}) {
    const auto address = ParseAddress("--listen", text);
    ASSERT_TRUE(address.ok()) << address.status();
    EXPECT_EQ(address->ToString(), text);
  }
}

TEST(AddressTest, AnythingElseIsRefused) {
  for (const std::string text : {"", ":", "50051", ":50051", "host", "host:", "host:x", "host:-1",
                                 "host:65536", "a b:1", "::1:80", "a,b:1", "[]:1", "host:80s"}) {
    const auto address = ParseAddress("--listen", text);
    EXPECT_EQ(address.status().code(), absl::StatusCode::kInvalidArgument) << text;
    EXPECT_THAT(std::string(address.status().message()),
                HasSubstr("--listen: expected HOST:PORT, received \"" + text + "\""));
  }
}

TEST(OptionsTest, DefaultsNeedOnlyPolicies) {
  ServerOptions options;
  EXPECT_EQ(options.Validate().code(), absl::StatusCode::kInvalidArgument);
  options.policies = "policies";
  EXPECT_TRUE(options.Validate().ok()) << options.Validate();
  options.http_listen = "";
  EXPECT_TRUE(options.Validate().ok()) << options.Validate();
}

}  // namespace
}  // namespace spikeserve

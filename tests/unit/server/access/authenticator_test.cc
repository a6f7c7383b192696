#include "server/access/authenticator.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "server/base/retry_delay.h"
#include "tests/support/temporary_directory.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

std::string HashOf(absl::string_view token) {
  const Digest digest = Sha256(token);
  return absl::BytesToHexString({reinterpret_cast<const char*>(digest.data()), digest.size()});
}

std::string Entry(absl::string_view token, absl::string_view role, absl::string_view more = "") {
  return absl::StrCat(R"({"sha256": ")", HashOf(token), R"(", "tenant": "fleet", "role": ")", role,
                      "\"", more, "}");
}

std::string File(absl::string_view tokens, absl::string_view limits = "{}") {
  return absl::StrCat(R"({"tenants": {"fleet": )", limits, R"(}, "tokens": [)", tokens, "]}");
}

class AuthenticatorTest : public ::testing::Test {
 protected:
  void Write(const std::string& text) { std::ofstream(path_) << text; }
  std::unique_ptr<Authenticator> Create() {
    auto authenticator = Authenticator::Create(path_);
    EXPECT_TRUE(authenticator.ok()) << authenticator.status();
    return *std::move(authenticator);
  }

  TemporaryDirectory directory_;
  const std::string path_ = (directory_.path() / "tokens.json").string();
};

TEST(Sha256Test, IsThatOfTheStandard) {
  EXPECT_EQ(HashOf("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
}

TEST_F(AuthenticatorTest, RefusalsArePacedByTenant) {
  Write(File(Entry("a", "agent") + "," + Entry("b", "viewer")));
  const auto authenticator = Create();
  const auto refusals = [&](absl::string_view token) {
    return &authenticator->RefusalPacerFor(authenticator->Authenticate(token));
  };
  EXPECT_EQ(refusals("a"), refusals("b"));
  EXPECT_EQ(refusals("wrong"), refusals("none of them"));
  EXPECT_NE(refusals("a"), refusals("wrong"));
}

TEST_F(AuthenticatorTest, SeesItsTenantUnlessTheTokenSeesAll) {
  Write(File(Entry("own", "operator") + "," + Entry("all", "viewer", R"(, "sees": "all")")));
  const auto authenticator = Create();
  const auto own = *authenticator->Authenticate("own");
  EXPECT_TRUE(own->CanRead("fleet"));
  EXPECT_FALSE(own->CanRead("rival"));
  EXPECT_TRUE((*authenticator->Authenticate("all"))->CanRead("rival"));
}

TEST_F(AuthenticatorTest, MistakesInTheFileAreNamed) {
  const std::pair<std::string, std::string> cases[] = {
      {R"({"token": []})", "\"token\""},
      {File(R"({"sha256": "00", "tenant": "fleet", "role": "agent"})"), "tokens[0].sha256"},
      {File(Entry("a", "king")), "expected agent, viewer or operator"},
      {File(Entry("a", "agent") + "," + Entry("a", "agent")), "tokens[1].sha256"},
      {File(Entry("a", "agent", R"(, "expires": "soon")")), "tokens[0].expires"},
      {File(Entry("v", "viewer", R"(, "sees": "everything")")), "tokens[0].sees"},
      {File(Entry("a", "agent", R"(, "sees": "all")")), "tokens[0].sees: expected tenant"},
      {File("", R"({"max_sessions": -1})"), "tenants.fleet.max_sessions"},
      {File("", R"({"max_sessions": "many"})"), "expected an integer"},
      {R"({"tokens": [)" + Entry("a", "agent") + "]}", "tokens[0].tenant"},
  };
  for (const auto& [text, message] : cases) {
    const auto file = ParseTokenFile(text);
    EXPECT_THAT(std::string(file.status().message()), HasSubstr(message)) << text;
  }
}

TEST(TenantTest, DecisionsAreLimitedWithAHint) {
  Tenant tenant("fleet");
  tenant.SetLimits({.max_sessions = 0,
                    .decisions_per_second = 10.0,
                    .calls_per_second = {},
                    .max_message_bytes = 0});
  const absl::Duration start = absl::Seconds(100);
  for (int i = 0; i < 10; ++i) EXPECT_TRUE(tenant.AcquireDecision(start).ok()) << i;
  const absl::Status refused = tenant.AcquireDecision(start);
  EXPECT_EQ(refused.code(), absl::StatusCode::kResourceExhausted);
  ASSERT_TRUE(RetryDelay(refused).has_value());
  EXPECT_EQ(*RetryDelay(refused), absl::Milliseconds(100));
  EXPECT_FALSE(tenant.AcquireDecision(start + absl::Milliseconds(99)).ok());
  EXPECT_TRUE(tenant.AcquireDecision(start + absl::Milliseconds(100)).ok());
  EXPECT_FALSE(tenant.AcquireDecision(start + absl::Milliseconds(100)).ok());
}

TEST(TokenOfTest, ReadsBearerAndBasic) {
  std::string buffer;
  EXPECT_EQ(ExtractToken("Bearer secret", &buffer), "secret");
  EXPECT_EQ(ExtractToken("bearer secret", &buffer), "secret");
  EXPECT_EQ(ExtractToken("Basic " + absl::Base64Escape("anyone:secret"), &buffer), "secret");
  EXPECT_EQ(ExtractToken("secret", &buffer), "");
  EXPECT_EQ(ExtractToken("", &buffer), "");
}

}  // namespace
}  // namespace spikeserve

#include "server/access/authenticator.h"

#include <gtest/gtest.h>

#include <fstream>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "tests/support/temporary_directory.h"

namespace spikeserve {
namespace {

std::string Entry(absl::string_view token, absl::string_view role) {
  const Digest digest = Sha256(token);
  const std::string hash =
      absl::BytesToHexString({reinterpret_cast<const char*>(digest.data()), digest.size()});
  return absl::StrCat(R"({"sha256": ")", hash, R"(", "tenant": "fleet", "role": ")", role, "\"}");
}

TEST(AuthenticatorTest, RefusalsArePacedByTenant) {
  const TemporaryDirectory directory;
  const std::string path = (directory.path() / "tokens.json").string();
  std::ofstream(path) << R"({"tenants": {"fleet": {}}, "tokens": [)" << Entry("a", "agent") << ","
                      << Entry("b", "viewer") << "]}";
  const auto authenticator = Authenticator::Create(path);
  ASSERT_TRUE(authenticator.ok()) << authenticator.status();
  const auto refusals = [&](absl::string_view token) {
    return &(*authenticator)->RefusalPacerFor((*authenticator)->Authenticate(token));
  };
  EXPECT_EQ(refusals("a"), refusals("b"));
  EXPECT_EQ(refusals("wrong"), refusals("none of them"));
  EXPECT_NE(refusals("a"), refusals("wrong"));
}

}  // namespace
}  // namespace spikeserve

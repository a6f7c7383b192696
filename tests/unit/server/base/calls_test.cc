#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <set>
#include <string>

#include "inference/grpc_service.pb.h"
#include "server/base/method.h"
#include "server/base/trace_parent.h"
#include "server/trace/trace_options.h"
#include "spikeserve/v1/policy_admin.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Pair;

TEST(MethodTest, EveryMethodOfTheContractDeclaresItsRules) {
  for (const auto* service : {v1::ActRequest::descriptor()->file()->service(0),
                              v1::LoadPolicyRequest::descriptor()->file()->service(0)}) {
    for (int i = 0; i < service->method_count(); ++i) {
      const auto& method = *service->method(i);
      const v1::MethodRules& rules = method.options().GetExtension(v1::rules);
      EXPECT_NE(rules.access(), v1::MethodRules::ACCESS_UNSPECIFIED) << method.full_name();
      EXPECT_NE(rules.cost(), v1::MethodRules::COST_UNSPECIFIED) << method.full_name();
    }
  }
}

TEST(MethodTest, WhatChangesNothingIsDeclaredSo) {
  const auto* admin = v1::LoadPolicyRequest::descriptor()->file()->service(0);
  for (int i = 0; i < admin->method_count(); ++i) {
    const auto& declared = *admin->method(i);
    const bool reads =
        declared.options().idempotency_level() == google::protobuf::MethodOptions::NO_SIDE_EFFECTS;
    // Only operators change what is served, and read a policy's weights.
    EXPECT_EQ(reads && declared.name() != "PullPolicy",
              MethodNamed(declared.name()).access != Access::kOperatorOnly)
        << declared.full_name();
  }
}

TEST(MethodTest, MethodsAreFoundByNameAndByRequest) {
  std::set<std::string> names;
  for (const Method& method : AllMethods()) {
    EXPECT_TRUE(names.insert(method.name).second) << method.name;
    EXPECT_EQ(&MethodNamed(method.name), &method);
    EXPECT_EQ(&AllMethods()[method.index], &method);
    EXPECT_EQ(method.path, "/" + method.service + "/" + method.name);
  }
  EXPECT_EQ(names.size(), 54);
  EXPECT_EQ(&MethodOf<v1::SetLabelRequest>(), &MethodNamed("SetLabel"));
  // Act and ActStream have the same requests.
  EXPECT_EQ(&MethodOf<v1::ActRequest>(), &MethodNamed("Act"));
  EXPECT_EQ(&MethodOf<inference::ModelInferRequest>(), &MethodNamed("ModelInfer"));
}

TEST(MethodDeathTest, AnUnknownNameIsAMistakeOfThisProgram) {
  EXPECT_DEATH(MethodNamed("Fly"), "the method exists.*Fly");
}

const std::string kTrace = "0af7651916cd43dd8448eb211c80319c";
const std::string kSpan = "b7ad6b7169203331";

TEST(TraceParentTest, OnlyTheLowestFlagIsTheDecision) {
  EXPECT_FALSE(ParseTraceParent("00-" + kTrace + "-" + kSpan + "-fe").sampled);
  EXPECT_TRUE(ParseTraceParent("00-" + kTrace + "-" + kSpan + "-03").sampled);
}

TEST(TraceParentTest, ReadsLaterVersionsAsFarAsTheyAreKnown) {
  EXPECT_TRUE(ParseTraceParent("01-" + kTrace + "-" + kSpan + "-01").is_valid());
  EXPECT_TRUE(ParseTraceParent("01-" + kTrace + "-" + kSpan + "-01-more").is_valid());
  EXPECT_FALSE(ParseTraceParent("01-" + kTrace + "-" + kSpan + "-01more").is_valid());
}

TEST(TraceParentTest, RefusesWhatTheStandardCallsInvalid) {
  const std::string zeros(32, '0');
  for (const std::string& text : {
           std::string(),
           std::string("00"),
           "ff-" + kTrace + "-" + kSpan + "-01",
           "00-" + zeros + "-" + kSpan + "-01",
           "00-" + kTrace + "-" + zeros.substr(16) + "-01",
           "00-" + kTrace + "-" + kSpan + "-01-",
           "00-" + kTrace + "-" + kSpan + "-0",
           "00-" + kTrace + "-" + kSpan + "-0g",
           "00-" + kTrace + "_" + kSpan + "-01",
           "00-0AF7651916CD43DD8448EB211C80319C-" + kSpan + "-01",
           "0x-" + kTrace + "-" + kSpan + "-01",
       }) {
    EXPECT_FALSE(ParseTraceParent(text).is_valid()) << text;
  }
}

absl::StatusOr<TraceOptions> Read(const std::map<std::string, std::string>& environment) {
  return ReadTraceOptions([&](const std::string& name) -> const char* {
    const auto it = environment.find(name);
    return it == environment.end() ? nullptr : it->second.c_str();
  });
}

TEST(TraceOptionsTest, AreOffWithoutAnEndpoint) {
  EXPECT_FALSE(Read({})->enabled());
  EXPECT_FALSE(Read({{"OTEL_EXPORTER_OTLP_ENDPOINT", ""}})->enabled());
  EXPECT_FALSE(Read({{"OTEL_EXPORTER_OTLP_ENDPOINT", "http://a"}, {"OTEL_TRACES_EXPORTER", "none"}})
                   ->enabled());
  EXPECT_TRUE(Read({{"OTEL_TRACES_EXPORTER", "otlp"}})->enabled());
}

TEST(TraceOptionsTest, ReadsEndpoints) {
  const auto plain = Read({{"OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector:1234/"}});
  EXPECT_EQ(plain->host, "collector");
  EXPECT_EQ(plain->port, 1234);
  EXPECT_FALSE(plain->tls);
  const auto tls = Read({{"OTEL_EXPORTER_OTLP_ENDPOINT", "https://[::1]"}});
  EXPECT_EQ(tls->host, "::1");
  EXPECT_EQ(tls->port, 4317);
  EXPECT_TRUE(tls->tls);
  for (const char* wrong : {"collector:1234", "http://", "http://a:0", "http://a:65536",
                            "http://a/v1/traces", "ftp://a", "http://[::1", "http://me@a"}) {
    EXPECT_THAT(std::string(Read({{"OTEL_EXPORTER_OTLP_ENDPOINT", wrong}}).status().message()),
                HasSubstr("OTEL_EXPORTER_OTLP_ENDPOINT: expected http://HOST:PORT"))
        << wrong;
  }
}

TEST(TraceOptionsTest, PrefersTheVariableOfTraces) {
  const auto options = Read({{"OTEL_EXPORTER_OTLP_ENDPOINT", "http://all"},
                             {"OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "http://traces"}});
  EXPECT_EQ(options->host, "traces");
}

TEST(TraceOptionsTest, ReadsPairs) {
  const auto options = Read({{"OTEL_TRACES_EXPORTER", "otlp"},
                             {"OTEL_RESOURCE_ATTRIBUTES", "service.name=a, b = c%2Cd=e ,"},
                             {"OTEL_EXPORTER_OTLP_HEADERS", "Api-Key=x%3D"}});
  ASSERT_TRUE(options.ok()) << options.status();
  EXPECT_EQ(options->service_name, "a");
  EXPECT_THAT(options->resource, ElementsAre(Pair("b", "c,d=e")));
  EXPECT_THAT(options->headers, ElementsAre(Pair("api-key", "x=")));
}

TEST(TraceOptionsTest, ReadsSamplers) {
  const auto read = [](const char* sampler, const char* argument = "0.25") {
    return *Read({{"OTEL_TRACES_EXPORTER", "otlp"},
                  {"OTEL_TRACES_SAMPLER", sampler},
                  {"OTEL_TRACES_SAMPLER_ARG", argument}});
  };
  EXPECT_EQ(read("").ratio, 1.0);
  EXPECT_TRUE(read("").follows_parent);
  EXPECT_EQ(read("always_off").ratio, 0.0);
  EXPECT_FALSE(read("always_off").follows_parent);
  EXPECT_EQ(read("parentbased_traceidratio").ratio, 0.25);
  EXPECT_TRUE(read("parentbased_traceidratio").follows_parent);
  for (const char* wrong : {"1.1", "-0.1", "nan", "half"}) {
    const auto options = Read({{"OTEL_TRACES_EXPORTER", "otlp"},
                               {"OTEL_TRACES_SAMPLER", "traceidratio"},
                               {"OTEL_TRACES_SAMPLER_ARG", wrong}});
    EXPECT_THAT(std::string(options.status().message()), HasSubstr("OTEL_TRACES_SAMPLER_ARG"))
        << wrong;
  }
}

}  // namespace
}  // namespace spikeserve

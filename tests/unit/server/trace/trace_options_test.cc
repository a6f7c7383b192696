#include "server/trace/trace_options.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <string>

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Pair;

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

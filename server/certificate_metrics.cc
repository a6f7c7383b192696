#include "server/certificate_metrics.h"

#include <utility>

#include "server/metrics/gauge_family.h"

namespace spikeserve {

std::vector<prometheus::MetricFamily> CollectCertificates(const CertificateWatch& certificates) {
  auto failing = GaugeFamily("spikeserve_tls_reload_failing",
                             "1 while changed files of TLS cannot be used; the old ones are.");
  AddGauge(failing, {}, certificates.fails() ? 1.0 : 0.0);
  auto expiry = GaugeFamily("spikeserve_tls_expiry_timestamp_seconds",
                            "Unix time at which a certificate expires: server, with its chain, or "
                            "client_ca.");
  if (certificates.is_used()) {
    const CertificateTimes times = certificates.times();
    AddGauge(expiry, {{"certificate", "server"}},
             absl::ToDoubleSeconds(times.end - absl::UnixEpoch()));
    if (times.client_ca != absl::InfiniteFuture()) {
      AddGauge(expiry, {{"certificate", "client_ca"}},
               absl::ToDoubleSeconds(times.client_ca - absl::UnixEpoch()));
    }
  }
  return {std::move(failing), std::move(expiry)};
}

}  // namespace spikeserve

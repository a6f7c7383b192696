// Exports when certificates expire, and whether new ones can be used.
//
// Thread-safe.
#ifndef SERVER_CERTIFICATE_METRICS_H_
#define SERVER_CERTIFICATE_METRICS_H_

#include <vector>

#include "prometheus/metric_family.h"
#include "server/access/certificate_watch.h"

namespace spikeserve {

// Returns, read from `certificates`:
//   spikeserve_tls_reload_failing: 1 while changed files of TLS cannot be used
//   spikeserve_tls_expiry_timestamp_seconds{certificate}: Unix time; of the server's certificate
//     with its chain, and of the authorities of clients, if TLS uses them
std::vector<prometheus::MetricFamily> CollectCertificates(const CertificateWatch& certificates);

}  // namespace spikeserve

#endif  // SERVER_CERTIFICATE_METRICS_H_

//! Runs one case of the interoperability tests with tonic. Ends with status 0 if the server behaves as expected.
//!
//! usage: interop CASE ADDRESS PROTO_FOLDER [CA_FILE [CERTIFICATE KEY]]

mod cases;

use std::time::Duration;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

pub mod v1 {
    tonic::include_proto!("spikeserve.v1");
}
pub mod health {
    tonic::include_proto!("grpc.health.v1");
}

async fn connect(address: &str, files: &[String]) -> Result<Channel, Box<dyn std::error::Error>> {
    let timeout = Duration::from_secs(30);
    if files.is_empty() {
        let uri = match address.strip_prefix("unix:") {
            Some(path) => format!("unix://{path}"),
            None => format!("http://{address}"),
        };
        return Ok(Endpoint::from_shared(uri)?.connect_timeout(timeout).connect().await?);
    }
    let mut tls = ClientTlsConfig::new()
        .domain_name("localhost")
        .ca_certificate(Certificate::from_pem(std::fs::read(&files[0])?));
    if let [_, certificate, key] = files {
        tls = tls.identity(Identity::from_pem(std::fs::read(certificate)?, std::fs::read(key)?));
    }
    let endpoint = Endpoint::from_shared(format!("https://{address}"))?.tls_config(tls)?;
    Ok(endpoint.connect_timeout(timeout).connect().await?)
}

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let channel = connect(&arguments[2], &arguments[4..]).await?;
    tokio::time::timeout(Duration::from_secs(60), cases::run(&arguments[1], channel)).await?
}

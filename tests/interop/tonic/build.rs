//! Generates the clients of the wire contract.
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let proto = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../proto");
    let files = [
        "spikeserve/v1/policy_service.proto",
        "spikeserve/v1/policy_admin.proto",
        "grpc/health/v1/health.proto",
    ];
    let paths: Vec<String> = files.iter().map(|file| format!("{proto}/{file}")).collect();
    tonic_prost_build::configure()
        .build_server(false)
        .compile_protos(&paths, &[proto.to_string()])?;
    Ok(())
}

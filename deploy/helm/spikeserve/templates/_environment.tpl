{{/* The variables of the container: flags of the server, and those of the probe `spikectl health`. */}}
{{- define "spikeserve.environment" -}}
- {name: SPIKESERVE_LISTEN, value: "0.0.0.0:50051"}
- {name: SPIKESERVE_HTTP_LISTEN, value: "0.0.0.0:9464"}
{{- with .Values.datagrams.hostPort }}
- {name: NODE_IP, valueFrom: {fieldRef: {fieldPath: status.hostIP}}}
- {name: SPIKESERVE_DATAGRAM_LISTEN, value: "0.0.0.0:50052"}
- {name: SPIKESERVE_DATAGRAM_ADVERTISE, value: "$(NODE_IP):{{ int64 . }}"}
{{- end }}
- {name: SPIKESERVE_DRAIN_TIMEOUT, value: "{{ .Values.drain.timeoutSeconds }}s"}
- {name: SPIKESERVE_SESSION_TTL, value: {{ .Values.sessions.ttl | quote }}}
- {name: SPIKESERVE_MAX_SESSIONS, value: "{{ int64 .Values.sessions.max }}"}
- {name: SPIKESERVE_MAX_CONNECTION_AGE, value: {{ .Values.maxConnectionAge | quote }}}
- {name: SPIKESERVE_POLICIES, value: {{ ternary "/policies" "/usr/share/spikeserve/policies" (ne .Values.policies.claim "") }}}
- {name: SPIKESERVE_POLL_POLICIES, value: {{ .Values.policies.poll | quote }}}
{{- if eq .Values.sessions.store "file" }}
- {name: SPIKESERVE_SESSION_STORE, value: "file:/var/lib/spikeserve/sessions"}
- {name: SPIKESERVE_POLICY_SETTINGS, value: /var/lib/spikeserve/settings.json}
- {name: SPIKESERVE_AUDIT_LOG, value: /var/lib/spikeserve/audit.jsonl}
{{- else if eq .Values.sessions.store "redis" }}
- {name: SPIKESERVE_SESSION_STORE, value: {{ .Values.redis.address | quote }}}
- {name: SPIKESERVE_STORE_REPLICAS, value: "{{ .Values.redis.replicas }}"}
{{- if .Values.redis.passwordSecret }}
- {name: SPIKESERVE_STORE_PASSWORD_FILE, value: /etc/spikeserve/redis/password}
{{- end }}
{{- if .Values.redis.tlsSecret }}
- {name: SPIKESERVE_STORE_CA, value: /etc/spikeserve/redis-tls/ca.crt}
{{- end }}
{{- if .Values.redis.clientCertificate }}
- {name: SPIKESERVE_STORE_CERTIFICATE, value: /etc/spikeserve/redis-tls/tls.crt}
- {name: SPIKESERVE_STORE_KEY, value: /etc/spikeserve/redis-tls/tls.key}
{{- end }}
{{- end }}
{{- if ne .Values.sessions.store "memory" }}
- {name: SPIKESERVE_DURABILITY, value: {{ .Values.sessions.durability }}}
{{- end }}
{{- if .Values.signing.secret }}
- {name: SPIKESERVE_TRUSTED_KEYS, value: /etc/spikeserve/signing/trusted.pem}
{{- end }}
{{- if .Values.signing.promotes }}
- {name: SPIKESERVE_SIGNING_KEY, value: /etc/spikeserve/signing/signing.pem}
{{- end }}
{{- if .Values.tls.secret }}
- {name: SPIKESERVE_TLS_CERTIFICATE, value: /etc/spikeserve/tls/tls.crt}
- {name: SPIKESERVE_TLS_KEY, value: /etc/spikeserve/tls/tls.key}
- {name: SPIKECTL_TLS_CA, value: /etc/spikeserve/tls/ca.crt}
{{- end }}
{{- if .Values.tls.clientCertificates }}
- {name: SPIKESERVE_TLS_CLIENT_CA, value: /etc/spikeserve/tls/ca.crt}
- {name: SPIKECTL_TLS_CERTIFICATE, value: /etc/spikeserve/tls/tls.crt}
- {name: SPIKECTL_TLS_KEY, value: /etc/spikeserve/tls/tls.key}
{{- end }}
{{- if .Values.tokens.secret }}
- {name: SPIKESERVE_TOKENS, value: /etc/spikeserve/tokens/tokens.json}
{{- end }}
{{- if .Values.insecureNetwork }}
- {name: SPIKESERVE_INSECURE_NETWORK, value: "true"}
{{- end }}
{{- range $name, $value := .Values.flags }}
{{- /* YAML's numbers arrive as float64, which prints 4194304 as 4.194304e+06. */}}
{{- $text := ternary (int64 $value | toString) ($value | toString) (and (kindIs "float64" $value) (eq (floor $value) $value)) }}
- {name: SPIKESERVE_{{ upper $name }}, value: {{ $text | quote }}}
{{- end }}
- {name: SPIKECTL_SERVER, value: "{{ ternary .Values.tls.probeName "127.0.0.1" (ne .Values.tls.secret "") }}:50051"}
{{- with .Values.extraEnv }}
{{ toYaml . }}
{{- end }}
{{- end -}}

/* Reference sender: what a rig's program has to do to be heard by `atmd live`.
 *
 * One thread makes a block of samples every 100 ms and publishes it; between blocks it reads commands and answers
 * them. CURVE keeps strangers out: the small thread below answers ZeroMQ's question who may come in (ZAP, RFC 27).
 * docs/protocol.md describes every message; the numbers here are a sine, where a rig would read its converters.
 *
 *     gcc -std=c11 -O2 -Wall -Wextra -o sender sender.c -lzmq -lm -lpthread
 *     ./sender RIG.key_secret STATION.key PORT BLOCKS
 */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <zmq.h>

enum { RATE = 50000, BLOCK = 5000, COLUMNS = 7, KEY = 41 };

static const char *const NAMES[COLUMNS] = {"table_acceleration", "absorber_acceleration", "vcm_current",
                                           "vcm_voltage", "shaker_current", "shaker_voltage", "vcm"};
static const char *const UNITS[COLUMNS] = {"m/s^2", "g", "A", "V", "A", "V", "A"};
static const double PEAKS[COLUMNS] = {1.0, 0.5, 0.0, 0.0, 1.5, 4.0, 0.0};

static char station_key[KEY];

static void fail(const char *what) {
    fprintf(stderr, "sender: %s: %s\n", what, zmq_strerror(zmq_errno()));
    exit(3);
}

static double now_s(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* The value of `name = "..."` in a ZeroMQ certificate; 1 if it is there. */
static int read_key(const char *path, const char *name, char *key) {
    FILE *file = fopen(path, "r");
    char line[256], pattern[64];
    int found = 0;
    if (file == NULL) {
        fprintf(stderr, "sender: %s: cannot be read\n", path);
        exit(2);
    }
    snprintf(pattern, sizeof pattern, " %s = \"%%40[^\"]\"", name);
    while (fgets(line, sizeof line, file) != NULL)
        found = found || sscanf(line, pattern, key) == 1;
    fclose(file);
    return found && strlen(key) == KEY - 1;
}

/* ZAP: let in the one station whose public key we know. */
static void *gatekeeper(void *zap) {
    for (;;) {
        char parts[8][256];
        size_t sizes[8];
        int n = 0, more = 1;
        while (more && n < 8) {
            int size = zmq_recv(zap, parts[n], sizeof parts[n], 0);
            size_t length = sizeof more;
            if (size < 0)
                return NULL; /* the context is closing */
            sizes[n++] = (size_t)size < sizeof parts[0] ? (size_t)size : sizeof parts[0];
            zmq_getsockopt(zap, ZMQ_RCVMORE, &more, &length);
        }
        /* version, request id, domain, address, identity, mechanism, then the client's key in 32 bytes */
        char known[KEY] = "";
        if (n == 7 && sizes[5] == 5 && memcmp(parts[5], "CURVE", 5) == 0 && sizes[6] == 32)
            zmq_z85_encode(known, (const uint8_t *)parts[6], 32);
        int welcome = strcmp(known, station_key) == 0;
        zmq_send(zap, "1.0", 3, ZMQ_SNDMORE);
        zmq_send(zap, parts[1], n > 1 ? sizes[1] : 0, ZMQ_SNDMORE);
        zmq_send(zap, welcome ? "200" : "400", 3, ZMQ_SNDMORE);
        zmq_send(zap, welcome ? "OK" : "unknown key", welcome ? 2 : 11, ZMQ_SNDMORE);
        zmq_send(zap, "", 0, ZMQ_SNDMORE);
        zmq_send(zap, "", 0, 0);
    }
}

static void *bound(void *context, int type, const char *secret, int port) {
    void *socket = zmq_socket(context, type);
    char address[64];
    int yes = 1, none = 0;
    zmq_setsockopt(socket, ZMQ_CURVE_SERVER, &yes, sizeof yes);
    zmq_setsockopt(socket, ZMQ_CURVE_SECRETKEY, secret, KEY);
    zmq_setsockopt(socket, ZMQ_ZAP_DOMAIN, "rig", 3);
    zmq_setsockopt(socket, ZMQ_LINGER, &none, sizeof none);
    snprintf(address, sizeof address, "tcp://127.0.0.1:%d", port);
    if (zmq_bind(socket, address) != 0)
        fail(address);
    return socket;
}

/* A whole number that follows "name": in a JSON message; -1 if there is none. */
static long long number_after(const char *text, const char *name) {
    const char *at = strstr(text, name);
    long long value = -1;
    return at != NULL && sscanf(at + strlen(name), "\":%lld", &value) == 1 ? value : -1;
}

/* The first of several answers wins: accepted commands are told with the sample at which they act. */
static void answer_commands(void *commands, long long next_sample, int *control_on, char *applied, size_t room) {
    char who[256], text[65536];
    int size, who_size;
    while ((who_size = zmq_recv(commands, who, sizeof who, ZMQ_DONTWAIT)) >= 0) {
        size = zmq_recv(commands, text, sizeof text - 1, 0);
        if (size < 0 || who_size > (int)sizeof who)
            continue;
        text[size < (int)sizeof text - 1 ? size : (int)sizeof text - 1] = '\0';
        if (strstr(text, "\"type\":\"command\"") == NULL)
            continue; /* start, stop and heartbeats need no answer */
        long long id = number_after(text, "\"command_id");
        char reply[256];
        int on = strstr(text, "\"control_enabled\":true") != NULL;
        int off = strstr(text, "\"control_enabled\":false") != NULL;
        if (id < 1) {
            snprintf(reply, sizeof reply,
                     "{\"type\":\"ack\",\"command_id\":0,\"accepted\":false,\"reason\":\"no command_id\"}");
        } else if (!on && !off) {
            snprintf(reply, sizeof reply,
                     "{\"type\":\"ack\",\"command_id\":%lld,\"accepted\":false,"
                     "\"reason\":\"this sender has no gains to change\"}", id);
        } else {
            *control_on = on;
            snprintf(applied, room, "%lld", id);
            snprintf(reply, sizeof reply,
                     "{\"type\":\"ack\",\"command_id\":%lld,\"accepted\":true,\"applied_at_sample\":%lld,"
                     "\"reason\":\"\"}", id, next_sample);
        }
        zmq_send(commands, who, (size_t)who_size, ZMQ_SNDMORE);
        zmq_send(commands, reply, strlen(reply), 0);
    }
}

int main(int argc, char **argv) {
    char secret[KEY] = "", hello[2048], header[512], channels[1024] = "";
    static float samples[BLOCK][COLUMNS];
    if (argc != 5 || !read_key(argv[1], "secret-key", secret) || !read_key(argv[2], "public-key", station_key)) {
        fprintf(stderr, "usage: %s RIG.key_secret STATION.key PORT BLOCKS\n", argv[0]);
        return 2;
    }
    int port = atoi(argv[3]), blocks = atoi(argv[4]), control_on = 1;

    void *context = zmq_ctx_new();
    void *zap = zmq_socket(context, ZMQ_REP);
    pthread_t thread;
    if (zmq_bind(zap, "inproc://zeromq.zap.01") != 0) /* before the other sockets, or they let nobody in */
        fail("gatekeeper");
    pthread_create(&thread, NULL, gatekeeper, zap);
    void *data = bound(context, ZMQ_PUB, secret, port);
    void *commands = bound(context, ZMQ_ROUTER, secret, port + 1);

    for (int c = 0; c < COLUMNS; c++) {
        char one[128];
        snprintf(one, sizeof one, "%s{\"name\":\"%s\",\"unit\":\"%s\"}", c ? "," : "", NAMES[c], UNITS[c]);
        strcat(channels, one);
    }
    double begin = now_s();
    long run = (long)getpid(); /* another number at every start */
    snprintf(hello, sizeof hello,
             "{\"version\":2,\"run_id\":\"%ld\",\"sample_rate_hz\":%d,\"block_samples\":%d,\"channels\":[%s]}", run,
             RATE, BLOCK, channels);
    for (int k = 0; k < blocks; k++) {
        long long first = (long long)k * BLOCK;
        char applied[32] = "";
        answer_commands(commands, first, &control_on, applied, sizeof applied);
        for (int i = 0; i < BLOCK; i++)
            for (int c = 0; c < COLUMNS; c++)
                samples[i][c] = (float)(PEAKS[c] * sin(6.283185307179586 * 50.0 * (double)(first + i) / RATE + c));
        while (now_s() < begin + (k + 1) * (double)BLOCK / RATE) {
            struct timespec nap = {0, 1000000};
            nanosleep(&nap, NULL);
        }
        if (k % 10 == 0) {
            zmq_send(data, "hello", 5, ZMQ_SNDMORE);
            zmq_send(data, hello, strlen(hello), 0);
        }
        snprintf(header, sizeof header,
                 "{\"run_id\":\"%ld\",\"sequence\":%d,\"first_sample\":%lld,\"n_samples\":%d,\"control_on\":%s,"
                 "\"commands_applied\":[%s]}", run, k, first, BLOCK, control_on ? "true" : "false", applied);
        zmq_send(data, "samples", 7, ZMQ_SNDMORE);
        zmq_send(data, header, strlen(header), ZMQ_SNDMORE);
        zmq_send(data, samples, sizeof samples, 0); /* float32, little-endian, row by row */
    }
    zmq_send(data, "end", 3, ZMQ_SNDMORE);
    snprintf(header, sizeof header, "{\"next_sample\":%lld}", (long long)blocks * BLOCK);
    zmq_send(data, header, strlen(header), 0);
    struct timespec leave = {0, 300000000};
    nanosleep(&leave, NULL); /* let the last messages go */
    zmq_close(data);
    zmq_close(commands);
    zmq_ctx_shutdown(context); /* ends the gatekeeper's wait */
    pthread_join(thread, NULL);
    zmq_close(zap);
    zmq_ctx_term(context);
    return 0;
}

/* The floor: the least that a program must do to move frames between a port and a bus.
 *
 *   floor PORT BUS [WINDOW]        PORT and BUS as load.c takes them
 *
 * The relay's system calls with its batch sizes, and nothing else: no codec (all lines are 22 characters, all
 * frames the same), no queue, no accounting, no time, no errors. What the relay takes beyond this is the price
 * of what it does. WINDOW: lines that may be unanswered; an answer has two characters. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

/* The batch sizes. */
#include "../../bridged/relay/intake.h"
#include "../../bridged/relay/receive.h"

enum { LINE = 22, ANSWER = 2, PORT = 1, BUS = 2 };

static const char LINE_TEXT[LINE + 1] = "t12381122334455667788\r";

static char in[PORT_BUFFER], out[WINDOW_MAX * LINE];
static struct can_frame rx[RX_BATCH];
static struct iovec rx_iov[RX_BATCH], bus_iov[INTAKE_BATCH];
static struct mmsghdr rx_msg[RX_BATCH], bus_msg[INTAKE_BATCH];
static struct {
    struct canfd_frame frame;
    char control[128];
} bus_message[INTAKE_BATCH];

static void die(const char *what)
{
    perror(what);
    exit(1);
}

static int port_open(const char *text)
{
    struct termios t;
    int fd = text[0] == '/' ? open(text, O_RDWR | O_NOCTTY | O_NONBLOCK) : atoi(text);
    if (fd < 0 || fcntl(fd, F_SETFL, fcntl(fd, F_GETFL) | O_NONBLOCK) < 0)
        die(text);
    if (!tcgetattr(fd, &t)) {
        cfmakeraw(&t);
        tcsetattr(fd, TCSANOW, &t);
    }
    return fd;
}

static int bus_open(const char *text)
{
    if (!if_nametoindex(text))
        return atoi(text);
    int fd = socket(AF_CAN, SOCK_RAW, CAN_RAW), on = 1;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(text)};
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, sizeof address) < 0)
        die(text);
    int size = 4 << 20; /* as our bus end has it, and a time stamp with each frame */
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on);
    setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &size, sizeof size);
    setsockopt(fd, SOL_SOCKET, SO_SNDBUFFORCE, &size, sizeof size);
    return fd;
}

static void init(void)
{
    for (int i = 0; i < RX_BATCH; i++) {
        rx[i] = (struct can_frame){.can_id = 0x123, .len = 8};
        rx_iov[i] = (struct iovec){&rx[i], sizeof rx[i]};
        rx_msg[i].msg_hdr = (struct msghdr){.msg_iov = &rx_iov[i], .msg_iovlen = 1};
    }
    for (int i = 0; i < INTAKE_BATCH; i++) {
        bus_iov[i] = (struct iovec){&bus_message[i].frame, sizeof bus_message[i].frame};
        bus_msg[i].msg_hdr = (struct msghdr){
            .msg_iov = &bus_iov[i], .msg_iovlen = 1, .msg_control = bus_message[i].control};
    }
    for (int i = 0; i < WINDOW_MAX; i++)
        memcpy(out + i * LINE, LINE_TEXT, LINE);
}

int main(int argc, char **argv)
{
    if (argc < 3)
        die("floor PORT BUS [WINDOW]");
    prctl(PR_SET_PDEATHSIG, 9);
    int port = port_open(argv[1]), bus = bus_open(argv[2]), window = argc > 3 ? atoi(argv[3]) : 1;
    size_t have = 0, answers = 0;
    int waiting = 0, inflight = 0; /* frames read from the bus; lines not answered */
    init();
    puts("ready");
    fflush(stdout);
    int epoll = epoll_create1(0);
    struct epoll_event on_port = {.events = EPOLLIN, .data.u32 = PORT}, on_bus = {.events = EPOLLIN, .data.u32 = BUS};
    if (epoll_ctl(epoll, EPOLL_CTL_ADD, port, &on_port) < 0 || epoll_ctl(epoll, EPOLL_CTL_ADD, bus, &on_bus) < 0)
        die("epoll_ctl");
    for (;;) {
        struct epoll_event events[2];
        unsigned int ready = 0;
        for (int i = epoll_wait(epoll, events, 2, -1); i-- > 0;)
            ready |= events[i].data.u32;
        if (ready & PORT) {
            ssize_t n = read(port, in + have, sizeof in - have);
            if (n <= 0)
                return 0;
            if (inflight) { /* nothing but answers */
                answers += (size_t)n;
                inflight -= (int)(answers / ANSWER);
                answers %= ANSWER;
            } else {
                have += (size_t)n;
                int frames = (int)(have / LINE), sent = 0;
                while (sent < frames) {
                    int batch = frames - sent < RX_BATCH ? frames - sent : RX_BATCH;
                    int done = batch > 1 ? sendmmsg(bus, rx_msg, (unsigned int)batch, MSG_DONTWAIT | MSG_NOSIGNAL)
                                         : send(bus, &rx[0], sizeof rx[0], MSG_DONTWAIT | MSG_NOSIGNAL) > 0;
                    if (done > 0)
                        sent += done;
                    else
                        usleep(1000); /* full: RX_RETRY_NS of the relay */
                }
                have %= LINE;
            }
        }
        if (ready & BUS) {
            for (int i = 0; i < INTAKE_BATCH; i++)
                bus_msg[i].msg_hdr.msg_controllen = sizeof bus_message[i].control;
            int n = recvmmsg(bus, bus_msg, INTAKE_BATCH, MSG_DONTWAIT, NULL);
            waiting += n > 0 ? n : 0;
        }
        int go = waiting < window - inflight ? waiting : window - inflight;
        if (go > 0) {
            if (write(port, out, (size_t)go * LINE) != go * LINE)
                die("write");
            waiting -= go;
            inflight += go;
        }
    }
}

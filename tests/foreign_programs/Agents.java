import java.io.IOException;
import java.net.DatagramPacket;
import java.net.DatagramSocket;
import java.net.InetAddress;
import java.net.SocketTimeoutException;
import java.nio.ByteBuffer;
import java.util.Arrays;
import java.util.concurrent.atomic.AtomicInteger;
import java.util.concurrent.locks.LockSupport;

/**
 * A controller and a robot that know nothing of hil-runtime: plain UDP, a socket to send and another to receive at each
 * end, as the agents of Lv, Pang, Xiao and Yang. Both say what they sent and received.
 */
public final class Agents {
    private static final int COMMAND_PORT = 6001;
    private static final int STATUS_PORT = 6002;
    private static final int READY_PORT = 6003;
    private static final int TIMEOUT_MS = 5_000;

    public static void main(String[] arguments) throws Exception {
        InetAddress peer = InetAddress.getByName(arguments[1]);
        if (arguments[0].equals("controller")) {
            control(peer, Integer.parseInt(arguments[2]), Long.parseLong(arguments[3]) * 1_000_000);
        } else {
            drive(peer);
        }
    }

    /** Sends a command each period and takes what status comes. */
    private static void control(InetAddress robot, int count, long periodNs) throws Exception {
        long[] sentNs = new long[count];
        long[] responsesNs = new long[count];
        AtomicInteger received = new AtomicInteger();
        try (DatagramSocket out = new DatagramSocket(); DatagramSocket in = new DatagramSocket(STATUS_PORT)) {
            try (DatagramSocket ready = new DatagramSocket(READY_PORT)) {
                receive(ready);
            }
            in.setSoTimeout(TIMEOUT_MS);
            Thread receiver = new Thread(() -> {
                try {
                    while (true) {
                        int number = receive(in);
                        responsesNs[received.getAndIncrement()] = System.nanoTime() - sentNs[number];
                    }
                } catch (SocketTimeoutException silence) {
                    // The last status was received.
                } catch (IOException error) {
                    throw new IllegalStateException(error);
                }
            });
            receiver.start();
            long next = System.nanoTime();
            for (int number = 0; number < count; number++) {
                while (System.nanoTime() < next) {
                    LockSupport.parkNanos(next - System.nanoTime());
                }
                sentNs[number] = System.nanoTime();
                send(out, robot, COMMAND_PORT, number);
                next += periodNs;
            }
            receiver.join();
        }
        long[] sorted = Arrays.copyOf(responsesNs, received.get());
        Arrays.sort(sorted);
        long median = sorted.length > 0 ? sorted[sorted.length / 2] / 1_000 : 0;
        System.err.printf("%d commands sent, %d status received, median response %d us%n", count, sorted.length, median);
    }

    /** Answers each command by a status, until the run ends. */
    private static void drive(InetAddress controller) throws Exception {
        try (DatagramSocket in = new DatagramSocket(COMMAND_PORT); DatagramSocket out = new DatagramSocket()) {
            in.setSoTimeout(100);
            for (int received = 0; ; ) {
                try {
                    int number = receive(in);
                    received++;
                    send(out, controller, STATUS_PORT, number);
                    System.err.printf("%d commands received%n", received);
                } catch (SocketTimeoutException silence) {
                    if (received == 0) {
                        send(out, controller, READY_PORT, 0);
                    }
                }
            }
        }
    }

    private static void send(DatagramSocket socket, InetAddress address, int port, int number) throws IOException {
        byte[] bytes = ByteBuffer.allocate(64).putInt(number).array();
        socket.send(new DatagramPacket(bytes, bytes.length, address, port));
    }

    private static int receive(DatagramSocket socket) throws IOException {
        DatagramPacket packet = new DatagramPacket(new byte[64], 64);
        socket.receive(packet);
        return ByteBuffer.wrap(packet.getData()).getInt();
    }
}
